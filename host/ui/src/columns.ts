// A loop's past and present as columns for drawing: what the log told, then what the feed brings.
//
//   view ─ not covered, or too coarse ─► ask the log (half a span more on either side) ─► columns ─┐
//   feed ─► rows behind the last of the log ───────────────────────────────────────────────────────┴─► drawn
//
// Never: averages or invents; each entry is a recorded cycle.

import { get } from "./api";
import type { Trace } from "./live";
import type { Notice, Trend } from "./types";

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
});

interface Part {
  from: number;
  to: number;
  piece: number;
  trend: Trend;
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
    return this.part?.trend.notices ?? [];
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
        const trend = await get<Trend>(`/v1/loops/${encodeURIComponent(this.loop)}/trend?${query}`);
        this.part = { from, to, piece: (to - from) / points, trend };
        this.failure = trend.read_to_unix_us < to * 1e6 - 1 ? "only the beginning of this window: it has very many cycles" : "";
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
    }
    return all;
  }
}
