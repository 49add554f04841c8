// The live feed: one connection for the whole page, and what it brought, as signals.
//
//   connecting ─ first event ─► live ─ silence (SILENCE_MS) or an error ─► lost ─ RETRY_MS ─► connecting, after the last id
//
// While it is not live everything on the page is grey: a number that may be old must not look like one that is not.
// Never: a command, or a request besides the feed and the lists that it tells to be old.

import { batch, computed, signal, type Signal } from "@preact/signals";
import { get, list, words } from "./api";
import type { AlarmChange, FieldNews, Host, Loop, Notice, Point, Row, Rows, Standing, Trend } from "./types";

/** Longest silence of a connection that is alive: hosts are told every second. */
const SILENCE_MS = 3_500;
const RETRY_MS = 700;
const BEAT_MS = 200;
/** Deviations that a spark line shows, one per beat: a minute. */
const SPARK = 300;
const NOTICES_MAX = 2_000;
/** Traced cycles kept for the trend: half an hour at 10 Hz. */
const TRACE_MAX = 20_000;

export type Link = "connecting" | "live" | "lost";

export const link = signal<Link>("connecting");
export const lost_at = signal<number | null>(null);
export const hosts = signal<Host[]>([]);
export const notices = signal<Notice[]>([]);
export const points = signal<Map<string, Point>>(new Map());
/** Points that a person holds at a value. */
export const forced = computed(() => [...points.value.values()].filter((point) => point.force));
/** What the feed last told of alarms. */
export const alarm_news = signal<AlarmChange[]>([]);
/** Grows when a job moved. */
export const job_news = signal(0);
export const trouble = signal("");
/** Records that this page was too slow for, since it was loaded. */
export const lost_rows = signal(0);
export const demo = signal(false);

/** A loop as the page follows it. */
export class Followed {
  readonly row: Signal<Row | null> = signal(null);
  readonly standing: Signal<Standing | null> = signal(null);
  readonly spec: Signal<Loop | null> = signal(null);
  /** When the last row came, by this page's clock, in ms. */
  seen = 0;
  /** Deviations in % of the setpoint's range, a ring. */
  readonly spark = new Float32Array(SPARK).fill(Number.NaN);
  spark_at = 0;
  constructor(readonly name: string) {}

  push(row: Row): void {
    this.seen = performance.now();
    const range = this.spec.peek()?.spec.setpoint_range;
    const span = range ? range[1] - range[0] : 0;
    const known = row.measurement !== null && row.setpoint !== null && span > 0;
    this.spark[this.spark_at] = known ? (100 * ((row.measurement as number) - (row.setpoint as number))) / span : Number.NaN;
    this.spark_at = (this.spark_at + 1) % SPARK;
    this.row.value = row;
  }
}

let filling: Promise<unknown> = Promise.resolve();
const filled = new Set<string>();

/** Fills a spark line with the minute before the page was opened; one loop after the other, once each. */
export function backfill(loop: Followed): void {
  const row = loop.row.peek();
  const range = loop.spec.peek()?.spec.setpoint_range;
  if (!row || !range || filled.has(loop.name)) return;
  filled.add(loop.name);
  const [to, span] = [row.at_unix_us, range[1] - range[0]];
  const from = to - SPARK * BEAT_MS * 1_000;
  filling = filling.then(async () => {
    try {
      const trend = await get<Trend>(`/v1/loops/${encodeURIComponent(loop.name)}/trend?from_unix_us=${from}&to_unix_us=${to}&points=60`);
      const beats_since = Math.round(((loop.row.peek()?.at_unix_us ?? to) - to) / 1_000 / BEAT_MS);
      let before = Number.NaN;
      let at = 0;
      // From the oldest entry on, as far as the feed has not written since.
      for (let age = SPARK; age > beats_since + 1; age--) {
        const time = to - (age - beats_since) * BEAT_MS * 1_000;
        while (at < trend.at_unix_us.length && (trend.at_unix_us[at] as number) <= time) {
          const [pv, sp] = [trend.measurement[at], trend.setpoint[at]];
          before = pv === null || pv === undefined || sp === null || sp === undefined ? Number.NaN : (100 * (pv - sp)) / span;
          at += 1;
        }
        const place = (loop.spark_at - age + 2 * SPARK) % SPARK;
        if (Number.isNaN(loop.spark[place] as number)) loop.spark[place] = before;
      }
    } catch {
      // The line then begins with the page; it says nothing else.
    }
  });
}

/** All loops by name. The map is new when a loop comes or goes. */
export const loops = signal<Map<string, Followed>>(new Map());

/** Ticks twice a second, so that ages go on while nothing comes. */
export const tick = signal(0);
setInterval(() => (tick.value += 1), 500);

/** Does a loop still move? No cycle for three periods and two seconds is too old. */
export function is_old(loop: Followed): boolean {
  const period = loop.spec.value?.spec.period_ms ?? 1_000;
  return loop.seen === 0 || performance.now() - loop.seen > Math.max(2_000, 3 * period + 2 * BEAT_MS);
}

/** Cycles of the loop whose trend is shown, all of them. */
export interface Trace {
  loop: string;
  rows: (Row & { online: number })[];
}
export const trace: Trace = { loop: "", rows: [] };
export const trace_grew = signal(0);

let source: EventSource | null = null;
let last_id = "";
let last_event = performance.now();
let retry: number | undefined;

/** Follows every cycle of one loop; of none where the name is empty. */
export function follow(loop: string): void {
  if (trace.loop === loop) return;
  trace.loop = loop;
  trace.rows = [];
  connect(false);
}

function connect(resume: boolean): void {
  source?.close();
  clearTimeout(retry);
  const query = new URLSearchParams({ form: "rows", every_ms: String(BEAT_MS) });
  if (trace.loop) query.set("trace", trace.loop);
  if (resume && last_id) query.set("after", last_id);
  const feed = new EventSource(`/v1/live?${query}`);
  source = feed;
  const on = <T>(name: string, take: (data: T) => void): void =>
    feed.addEventListener(name, (event) => {
      if (source !== feed) return;
      last_event = performance.now();
      last_id = event.lastEventId;
      batch(() => {
        if (link.value !== "live") came_back();
        take(JSON.parse(event.data) as T);
      });
    });
  on<Rows>("rows", take_rows);
  on<Notice[]>("notices", take_notices);
  on<{ hosts: Host[] }>("hosts", (data) => (hosts.value = data.hosts));
  on<Standing[]>("loops", take_standing);
  on<{ lost: number; news: FieldNews[] }>("field", take_field);
  on<AlarmChange[]>("alarms", (changes) => (alarm_news.value = changes));
  feed.onerror = () => {
    if (source === feed) is_lost();
  };
}

function is_lost(): void {
  source?.close();
  source = null;
  if (link.value !== "lost") {
    link.value = "lost";
    lost_at.value = Date.now();
  }
  clearTimeout(retry);
  retry = window.setTimeout(() => connect(true), RETRY_MS);
}

function came_back(): void {
  const before = link.peek();
  link.value = "live";
  lost_at.value = null;
  if (before === "lost") void load();
}

let looked = performance.now();
setInterval(() => {
  // A page that was held up itself finds its events behind this timer, and one that is hidden gets its timers late: that
  // silence is its own.
  const held_up = performance.now() - looked > 1_000;
  looked = performance.now();
  if (held_up) last_event = looked;
  if (source && !document.hidden && performance.now() - last_event > SILENCE_MS) {
    last_event = performance.now();
    is_lost();
  }
}, 250);

function take_rows(data: Rows): void {
  lost_rows.value += data.lost;
  const known = loops.peek();
  for (const row of data.loops) known.get(row.loop)?.push(row);
  if (data.trace.length > 0) {
    const online = known.get(trace.loop)?.standing.peek()?.members.length ?? 0;
    let last = trace.rows.at(-1);
    for (const row of data.trace) {
      if (row.loop !== trace.loop) continue;
      if (last && (row.term < last.term || (row.term === last.term && row.seq <= last.seq))) continue;
      last = { ...row, online };
      trace.rows.push(last);
    }
    if (trace.rows.length > TRACE_MAX) trace.rows.splice(0, trace.rows.length - TRACE_MAX);
    trace_grew.value += 1;
  }
}

function take_notices(fresh: Notice[]): void {
  const from = fresh[0]?.number ?? 0;
  // A host that was started again counts anew.
  const kept = notices.peek().filter((notice) => notice.number < from || notice.at_unix_us < (fresh[0]?.at_unix_us ?? 0));
  notices.value = [...kept, ...fresh].slice(-NOTICES_MAX);
}

let loading_specs = false;

function take_standing(all: Standing[]): void {
  const known = loops.peek();
  const names = new Set(all.map((standing) => standing.loop));
  const same = known.size === names.size && all.every((standing) => known.has(standing.loop));
  if (!same) {
    const next = new Map<string, Followed>();
    for (const { loop } of all) next.set(loop, known.get(loop) ?? new Followed(loop));
    loops.value = next;
  }
  let old = false;
  for (const standing of all) {
    const followed = loops.peek().get(standing.loop);
    if (!followed) continue;
    followed.standing.value = standing;
    const spec = followed.spec.peek();
    old ||= spec?.revision !== standing.revision || spec.pending_revision !== standing.pending_revision;
  }
  if (old) void load_specs();
}

/** Reads all loops' specifications again. */
export async function load_specs(): Promise<void> {
  if (loading_specs) return;
  loading_specs = true;
  try {
    let after = "";
    do {
      const query = after ? `?after=${encodeURIComponent(after)}` : "";
      const part = await get<{ loops: Loop[]; next: string | null }>(`/v1/loops${query}`);
      batch(() => {
        for (const loop of part.loops) {
          const followed = loops.peek().get(loop.name);
          if (followed) followed.spec.value = loop;
        }
      });
      after = part.next ?? "";
    } while (after);
    trouble.value = "";
  } catch (error) {
    trouble.value = words(error);
  } finally {
    loading_specs = false;
  }
}

/** Reads the points again. */
export async function load_points(): Promise<void> {
  try {
    const all = await list<Point>("/v1/points", "points");
    points.value = new Map(all.map((point) => [point.name, point]));
  } catch (error) {
    trouble.value = words(error);
  }
}

/** What happened to points by hand, and to jobs. */
function take_field(data: { lost: number; news: FieldNews[] }): void {
  const changed = new Map(points.peek());
  let [of_points, of_jobs] = [false, data.lost > 0];
  for (const { forced, unforced, job } of data.news) {
    const name = forced?.point ?? unforced?.point ?? "";
    const point = changed.get(name);
    if (point) {
      changed.set(name, { ...point, force: forced?.force ?? null });
      of_points = true;
    }
    of_jobs ||= job !== undefined;
  }
  if (of_points) points.value = changed;
  if (of_jobs) job_news.value += 1;
  if (data.lost > 0) void load_points();
}

/** Points of a loop that a person holds, by port. */
export function forced_ports(loop: Loop | null): { port: string; point: Point }[] {
  if (!loop || forced.value.length === 0) return [];
  return Object.entries(loop.spec.ports).flatMap(([port, name]) => {
    const point = points.value.get(name);
    return point?.force ? [{ port, point }] : [];
  });
}

/** What the feed does not bring by itself. */
async function load(): Promise<void> {
  try {
    const [told, is_demo] = await Promise.all([
      get<{ notices: Notice[] }>("/v1/notices?limit=1000"),
      get<{ demo: boolean }>("/v1/demo"),
    ]);
    batch(() => {
      notices.value = told.notices;
      demo.value = is_demo.demo;
    });
  } catch (error) {
    trouble.value = words(error);
  }
  await Promise.all([load_points(), load_specs()]);
}

/** Begins. */
export function start(): void {
  // The browser may know before the silence says so.
  addEventListener("offline", is_lost);
  addEventListener("online", () => connect(true));
  void load();
  connect(false);
}

export const here = computed(() => hosts.value.find((host) => host.here)?.name ?? "");

/** Unit, range and decimals of a loop's measurement: the point's, else what the component says. */
export function measure(loop: Loop | null): { unit: string; low: number; high: number; span: number } {
  const point = loop?.measured_port ? points.value.get(loop.spec.ports[loop.measured_port] ?? "") : undefined;
  const range = loop?.spec.setpoint_range ?? point?.range ?? [0, 100];
  return { unit: point?.unit ?? loop?.measured_unit ?? "", low: range[0], high: range[1], span: range[1] - range[0] };
}

/** Unit and range of an output: the loop's limit, else the point's range. */
export function actuate(loop: Loop | null, port: string): { unit: string; low: number; high: number; span: number } {
  const point = loop ? points.value.get(loop.spec.ports[port] ?? "") : undefined;
  const limit = loop?.spec.limits[port];
  const low = limit?.low ?? point?.range[0] ?? 0;
  const high = limit?.high ?? point?.range[1] ?? 100;
  return { unit: point?.unit ?? "", low, high, span: high - low };
}
