// Numbers, times and sizes as people read them: a fixed number of decimals per range, so that digits do not dance.

/** Decimals that show a thousandth of the span. */
export function decimals(span: number): number {
  if (!(span > 0)) return 3;
  return Math.min(6, Math.max(0, 3 - Math.floor(Math.log10(span) + 1e-9) - 1 + (span >= 1000 ? 0 : 1)));
}

/** A value with the decimals of its span; a dash where there is none. */
export function value(x: number | null | undefined, span = 100): string {
  if (x === null || x === undefined || !Number.isFinite(x)) return "–";
  return x.toFixed(decimals(span)).replace("-", "−");
}

/** µs as µs, ms or s. */
export function duration_us(us: number | null | undefined): string {
  if (us === null || us === undefined) return "–";
  if (us < 1_000) return us < 1 ? "0" : `${us.toFixed(0)} µs`;
  if (us < 1_000_000) return `${(us / 1_000).toFixed(us < 10_000 ? 2 : 1)} ms`;
  return `${(us / 1_000_000).toFixed(1)} s`;
}

/** Seconds as a span: 45 s, 12 min, 3.5 h. */
export function span_s(s: number): string {
  if (s < 60) return `${s.toFixed(0)} s`;
  if (s < 3_600) return `${(s / 60).toFixed(0)} min`;
  if (s < 172_800) return `${(s / 3_600).toFixed(1).replace(".0", "")} h`;
  return `${(s / 86_400).toFixed(1).replace(".0", "")} d`;
}

/** Bytes with a decimal prefix. */
export function bytes(n: number): string {
  if (n < 1_000) return `${n} B`;
  if (n < 1_000_000) return `${(n / 1_000).toFixed(0)} kB`;
  return `${(n / 1_000_000).toFixed(n < 10_000_000 ? 1 : 0)} MB`;
}

const clock_format = new Intl.DateTimeFormat(undefined, { hour: "2-digit", minute: "2-digit", second: "2-digit", hourCycle: "h23" });
const day_format = new Intl.DateTimeFormat(undefined, { year: "numeric", month: "2-digit", day: "2-digit" });
const zone_format = new Intl.DateTimeFormat("en", { timeZoneName: "short" });

/** Local time of day, to the second. */
export const clock = (ms: number): string => clock_format.format(ms);
/** Local day. */
export const day = (ms: number): string => day_format.format(ms);
/** Local day and time; the day is left out today. */
export function when(ms: number): string {
  return day(ms) === day(Date.now()) ? clock(ms) : `${day(ms)} ${clock(ms)}`;
}
/** The zone of local times, for example GMT+2. */
export function zone(ms = Date.now()): string {
  return zone_format.formatToParts(ms).find((part) => part.type === "timeZoneName")?.value ?? "local time";
}
/** So long ago. */
export function ago(ms: number): string {
  const s = Math.max(0, (Date.now() - ms) / 1_000);
  return s < 1 ? "now" : `${span_s(s)} ago`;
}

/** A number from a field, or nothing where it is none. */
export function number(text: string): number | null {
  const x = Number(text.replace(",", ".").replace("−", "-"));
  return text.trim() !== "" && Number.isFinite(x) ? x : null;
}
