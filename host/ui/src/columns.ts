// A loop's past and present as columns for drawing: what the history and the log told, then what the feed brings.
//
//   view ─ not covered, or too coarse ─► ask the log (half a span more on either side) ─► columns ─┐
//     └─ beyond the log, or too long for it ─► ask the history: means with least and greatest ─────┤
//   feed ─► rows behind the last of the log ───────────────────────────────────────────────────────┴─► drawn
//
// Never: averages or invents: an entry is a recorded cycle, or a piece of the history with its own mean, least and greatest.

import { get } from "./api";
import type { Trace } from "./live";
import type { History, Notice, Trend } from "./types";

/** Longer windows than this, in s, are drawn from the history alone: the log has too many cycles for one answer. */
const LOG_SPAN_MAX = 3_600;

export interface Columns {
  /** Times in s. */
  x: number[];
  seq: number[];
  setpoint: (number | null)[];
  measurement: (number | null)[];
  outputs: (number | null)[][];
  by: string[];
  owner: string[];
  step_us: number[];
  write_us: number[];
  /** Replicas on line; null where nobody noted it down: the log does not. */
  online: (number | null)[];
  good: boolean[];
  automatic: boolean[];
  /** Cycles that the entry stands for; 1 where it is one. */
  cycles: number[];
  /** Length of the piece in s; 0 for a cycle. */
  long: number[];
  measurement_min: (number | null)[];
  measurement_max: (number | null)[];
  outputs_min: (number | null)[][];
  outputs_max: (number | null)[][];
}

const empty = (ports: number): Columns => ({
  x: [],
  seq: [],
  setpoint: [],
  measurement: [],
  outputs: Array.from({ length: ports }, () => []),
  by: [],
  owner: [],
  step_us: [],
  write_us: [],
  online: [],
  good: [],
  automatic: [],
  cycles: [],
  long: [],
  measurement_min: [],
  measurement_max: [],
  outputs_min: Array.from({ length: ports }, () => []),
  outputs_max: Array.from({ length: ports }, () => []),
});

interface Part {
  from: number;
  to: number;
  piece: number;
  trend: Trend | null;
  /** What is before the log. */
  history: History | null;
}

/** The log's part of a view. */
export class Past {
  private part: Part | null = null;
  private asking = false;
  private wanted: { from: number; to: number; points: number } | null = null;
  private dead = false;
  failure = "";

  constructor(
    private readonly loop: string,
    private readonly changed: () => void,
  ) {}

  end(): void {
    this.dead = true;
  }

  /** Forgets what it has: there may be a gap in it. */
  forget(): void {
    this.part = null;
  }

  get notices(): Notice[] {
    return this.part?.trend?.notices ?? [];
  }

  /** Makes sure that a view (in s) is covered; `live_from` is where the feed's rows begin. */
  cover(min: number, max: number, pixels: number, live_from: number): void {
    const points = Math.min(4_000, Math.max(100, Math.round(pixels / 2)));
    const needed = (max - min) / points;
    const have = this.part;
    const end = Math.min(max, live_from);
    const covered = have !== null && have.from <= min && have.to >= end && have.piece <= 2.2 * needed;
    if (covered || end <= min) return;
    const half = (max - min) / 2;
    this.wanted = { from: min - half, to: Math.max(end, Math.min(max + half, live_from)), points: points * 2 };
    void this.ask();
  }

  private async ask(): Promise<void> {
    if (this.asking) return;
    this.asking = true;
    try {
      while (this.wanted && !this.dead) {
        const { from, to, points } = this.wanted;
        this.wanted = null;
        const query = `from_unix_us=${Math.max(0, Math.floor(from * 1e6))}&to_unix_us=${Math.ceil(to * 1e6)}&points=${Math.min(4_000, points)}`;
        const path = `/v1/loops/${encodeURIComponent(this.loop)}`;
        const piece = (to - from) / points;
        let trend: Trend | null = to - from > LOG_SPAN_MAX ? null : await get<Trend>(`${path}/trend?${query}`);
        // More cycles than one answer reads.
        if (trend && trend.read_to_unix_us < to * 1e6 - 1) trend = null;
        const begin = trend?.at_unix_us[0];
        const until = begin === undefined ? to : begin / 1e6;
        let history: History | null = null;
        if (until - from > Math.max(2, 3 * piece)) {
          const pieces = Math.max(1, Math.min(4_000, Math.round(points * ((until - from) / (to - from)))));
          const times = `from=${iso(Math.max(0, from))}&to=${iso(until)}`;
          // A cell that keeps no history says so; the log is shown all the same.
          history = await get<History>(`${path}/history?${times}&buckets=${pieces}`).catch(() => null);
        }
        this.part = { from, to, piece, trend, history };
        this.failure = trend || history ? "" : "neither the log nor the history has this window";
        this.changed();
      }
    } catch (error) {
      this.failure = error instanceof Error ? error.message : String(error);
      this.wanted = null;
      this.changed();
    } finally {
      this.asking = false;
    }
  }

  /** Log and feed in one, as far as the view and a little beyond. */
  columns(trace: Trace, ports: string[], min: number, max: number): Columns {
    const all = empty(ports.length);
    const margin = (max - min) * 0.02;
    const [low, high] = [min - margin, max + margin];
    const trend = this.part?.trend;
    const first_live = trace.rows[0];
    let last = 0;
    if (this.part?.history) last = this.pieces(all, this.part.history, ports, low, high, first_live?.at_unix_us ?? Infinity);
    if (trend) {
      for (let i = 0; i < trend.at_unix_us.length; i++) {
        const at = trend.at_unix_us[i] as number;
        // Where both have it the feed has more: each cycle, and who was on line.
        if (first_live && at >= first_live.at_unix_us) break;
        last = at;
        const x = at / 1e6;
        if (x < low || x > high) continue;
        all.x.push(x);
        all.seq.push(trend.seq[i] as number);
        all.setpoint.push(trend.setpoint[i] ?? null);
        all.measurement.push(trend.measurement[i] ?? null);
        for (const [n, port] of ports.entries()) (all.outputs[n] as (number | null)[]).push(trend.outputs[port]?.[i] ?? null);
        all.by.push(trend.hosts[trend.stepped_by[i] as number] ?? "");
        all.owner.push(trend.hosts[trend.owner[i] as number] ?? "");
        all.step_us.push(trend.step_us[i] as number);
        all.write_us.push(trend.committed_after_us[i] as number);
        all.online.push(null);
        all.good.push(trend.good[i] as boolean);
        all.automatic.push(trend.automatic[i] as boolean);
        single(all, ports.length);
      }
    }
    for (const row of trace.rows) {
      const x = row.at_unix_us / 1e6;
      if (row.at_unix_us <= last || x < low || x > high) continue;
      all.x.push(x);
      all.seq.push(row.seq);
      all.setpoint.push(row.setpoint);
      all.measurement.push(row.measurement);
      for (const [n, port] of ports.entries()) (all.outputs[n] as (number | null)[]).push(row.outputs[port] ?? null);
      all.by.push(row.stepped_by);
      all.owner.push(row.owner);
      all.step_us.push(row.step_us);
      all.write_us.push(row.committed_after_us);
      all.online.push(row.online);
      all.good.push(row.quality === "good");
      all.automatic.push(row.mode === "automatic");
      single(all, ports.length);
    }
    return all;
  }

  /** Puts the pieces of the history before `until` (µs); a gap is an entry without values. Gives the time of the last. */
  private pieces(all: Columns, history: History, ports: string[], low: number, high: number, until: number): number {
    let last = 0;
    let gap = 0;
    for (let i = 0; i < history.at_unix_us.length; i++) {
      const at = history.at_unix_us[i] as number;
      if (at >= until) break;
      last = at;
      const long = (history.ms[i] as number) / 1e3;
      const x = at / 1e6 + long / 2;
      if (x < low || x > high) continue;
      for (; gap < history.gaps.length && (history.gaps[gap]?.from_unix_us as number) <= at; gap++) {
        const from = (history.gaps[gap]?.from_unix_us as number) / 1e6;
        if (from > low && all.x.length > 0) this.entry(all, ports, from, 0, 0, null, history, 0);
      }
      this.entry(all, ports, x, long, history.cycles[i] as number, i, history, history.step_us.mean[i] ?? 0);
    }
    return last;
  }

  private entry(all: Columns, ports: string[], x: number, long: number, cycles: number, i: number | null, history: History, step: number): void {
    const value = (column: (number | null)[] | undefined): number | null => (i === null ? null : (column?.[i] ?? null));
    all.x.push(x);
    all.seq.push(0);
    all.setpoint.push(value(history.setpoint.mean));
    all.measurement.push(value(history.measurement.mean));
    all.measurement_min.push(value(history.measurement.min));
    all.measurement_max.push(value(history.measurement.max));
    for (const [n, port] of ports.entries()) {
      (all.outputs[n] as (number | null)[]).push(value(history.outputs[port]?.mean));
      (all.outputs_min[n] as (number | null)[]).push(value(history.outputs[port]?.min));
      (all.outputs_max[n] as (number | null)[]).push(value(history.outputs[port]?.max));
    }
    all.by.push("");
    all.owner.push("");
    all.step_us.push(step);
    all.write_us.push(0);
    all.online.push(null);
    all.good.push(i === null || history.bad[i] === 0);
    all.automatic.push(i === null || 2 * (history.manual[i] as number) <= cycles);
    all.cycles.push(cycles);
    all.long.push(long);
  }
}

/** A single cycle has no band. */
function single(all: Columns, ports: number): void {
  all.cycles.push(1);
  all.long.push(0);
  all.measurement_min.push(null);
  all.measurement_max.push(null);
  for (let n = 0; n < ports; n++) {
    (all.outputs_min[n] as (number | null)[]).push(null);
    (all.outputs_max[n] as (number | null)[]).push(null);
  }
}

/** A time in s as the API takes it. */
function iso(s: number): string {
  return encodeURIComponent(new Date(s * 1e3).toISOString());
}
