// Alarms as the cell tells them (ANSI/ISA-18.2): what stands, what is kept quiet, which limits there are, and the sound.
//
//   normal ─ comes ─► active ─ a person has seen it ─► acknowledged ─ goes ─► normal (latching: latched ─ reset ─► normal)
//                        └ goes ─► returned ─ a person has seen it ─► normal
//   beside it, each of them may be quiet: shelved, suppressed by design, out of service
//
// Never: decides; what an alarm is, and what may be done with it, is the loop's home's to say.

import { computed, effect, signal } from "@preact/signals";
import { get_list, send, remove } from "./api";
import { value } from "./format";
import { alarm_news, link, loops, points } from "./live";
import type { Alarm, AlarmDefinition, AlarmList, Flood, Priority } from "./types";
import { by } from "./who";

/** An alarm, with the time of its last coming and the end of its shelf by this page's clock, in ms. */
export interface Known extends Alarm {
  came_unix_ms: number | null;
  shelved_until_unix_ms: number | null;
}

/** Pause between two looks while the feed tells nothing: what it might have lost is made good. */
const LOOK_MS = 5_000;
/** Loops up to which all definitions are read, for the limits on the overview's bars. */
const DEFINED_LOOPS_MAX = 500;

/** All that are not normal, those that are kept quiet too, the most urgent and newest first. */
export const alarms = signal<Known[]>([]);
export const floods = signal<Flood[]>([]);
/** Homes that did not answer: their alarms are not here. */
export const silent_homes = signal<{ host: string; reason: string }[]>([]);
export const alarms_read = signal(false);
/** All alarms of a loop with their definitions, as far as they were read. */
export const defined = signal<Map<string, Known[]>>(new Map());

export const PRIORITIES: Priority[] = ["high", "medium", "low"];
export const RANK: Record<Priority, number> = { high: 1, medium: 2, low: 3 };

export const stands = (alarm: Alarm): boolean => alarm.state === "active" || alarm.state === "acknowledged";
/** Does it wait for a person to say that it was seen? */
export const is_unseen = (alarm: Alarm): boolean => !alarm.quiet && (alarm.state === "active" || alarm.state === "returned");
export const key_of = (alarm: { loop: string; name: string }): string => `${alarm.loop} ${alarm.name}`;

/** What an operator has before him: told, and not normal. */
export const told = computed(() => alarms.value.filter((alarm) => !alarm.quiet));
export const unseen = computed(() => alarms.value.filter(is_unseen));

/** By loop, so that a card looks at its own alone. */
const by_loop = computed(() => {
  const map = new Map<string, Known[]>();
  for (const alarm of alarms.value) {
    const own = map.get(alarm.loop);
    if (own) own.push(alarm);
    else map.set(alarm.loop, [alarm]);
  }
  return map;
});
const NONE: Known[] = [];
/** All of a loop that are not normal, quiet ones too. */
export const alarms_of = (loop: string): Known[] => by_loop.value.get(loop) ?? NONE;
/** Those of a loop that an operator has before him. */
export const told_of = (loop: string): Known[] => alarms_of(loop).filter((alarm) => !alarm.quiet);

/** The states in words. */
export const STATE: Record<Alarm["state"], string> = {
  normal: "normal",
  active: "stands, not seen",
  acknowledged: "stands, seen",
  returned: "gone, not seen",
  latched: "gone, wants a reset",
};

export const KINDS: Record<string, string> = {
  "hi-hi": "very high",
  hi: "high",
  lo: "low",
  "lo-lo": "very low",
  deviation: "far from the setpoint",
  rate: "changes too fast",
  "bad-quality": "measurement not usable",
  fault: "steps fail",
  overrun: "a step ran too long",
  "redundancy-lost": "replicas are missing",
  dissent: "a replica dissents",
  controller: "raised by the controller",
  clock: "a host's clock is off",
  disk: "a disk is full or fails",
  signature: "a loop runs a component that is not signed as the cell asks",
};
export const LEVELS = ["hi-hi", "hi", "lo", "lo-lo"];
export const has_limit = (kind: string): boolean => LEVELS.includes(kind) || kind === "deviation" || kind === "rate";

/** Unit and span of what an alarm looks at. */
export function scale_of(loop: string, definition: AlarmDefinition): { unit: string; span: number; low: number; high: number } {
  const spec = loops.value.get(loop)?.spec.value;
  const port = definition.port ?? spec?.measured_port ?? "";
  const point = points.value.get(spec?.spec.ports[port] ?? "");
  const range = point?.range ?? spec?.spec.setpoint_range ?? [0, 100];
  const unit = point?.unit ?? (port === spec?.measured_port ? (spec?.measured_unit ?? "") : "");
  return { unit: definition.kind === "rate" && unit ? `${unit}/s` : unit, span: range[1] - range[0], low: range[0], high: range[1] };
}

/** What it says, in one line: its limit and the value that it came at, or the controller's words. */
export function says(alarm: Alarm, brief = false): string {
  const { kind, limit } = alarm.definition;
  const words = KINDS[kind] ?? kind;
  if (kind === "controller" || alarm.text) return alarm.text || words;
  if (limit === null || limit === undefined) return words;
  const { unit, span } = scale_of(alarm.loop, alarm.definition);
  const at = alarm.value === null || brief ? "" : `, came at ${value(alarm.value, span)} ${unit}`;
  return `${words}: limit ${value(limit, span)} ${unit}${at}`.trimEnd();
}

function known(fresh: Alarm[], before: Map<string, Known>): Known[] {
  const now = Date.now();
  return fresh.map((alarm) => {
    const came = alarm.age_s === null ? null : now - alarm.age_s * 1_000;
    const old = before.get(key_of(alarm));
    // Two looks at the same coming differ by the way of the answer; the time on the screen must not.
    const same = old && old.comings === alarm.comings && came !== null && old.came_unix_ms !== null && Math.abs(old.came_unix_ms - came) < 3_000;
    return { ...alarm, came_unix_ms: same ? old.came_unix_ms : came, shelved_until_unix_ms: alarm.shelf ? now + alarm.shelf.seconds_left * 1_000 : null };
  });
}

export const in_order = (list: Known[]): Known[] =>
  [...list].sort((a, b) => RANK[a.priority] - RANK[b.priority] || (b.came_unix_ms ?? 0) - (a.came_unix_ms ?? 0) || key_of(a).localeCompare(key_of(b)));

let reading = false;
let again = false;

/** Reads what stands. Asked for while it reads, it reads once more. */
export async function load_alarms(): Promise<void> {
  if (reading) {
    again = true;
    return;
  }
  reading = true;
  try {
    do {
      again = false;
      const list = await get_list<AlarmList, Alarm>("/v1/alarms?quiet=true", (part) => part.alarms);
      const before = new Map(alarms.peek().map((alarm) => [key_of(alarm), alarm]));
      alarms.value = in_order(known(list.all, before));
      floods.value = list.last.floods;
      silent_homes.value = list.last.silent;
      alarms_read.value = true;
    } while (again);
  } catch {
    // The connection's own banner says so; what was read stays, grey.
  } finally {
    reading = false;
  }
}

/** Reads all alarms of a loop, with those that are normal; of every loop where none is named. */
export async function load_defined(loop?: string): Promise<void> {
  const query = loop ? `&loop=${encodeURIComponent(loop)}` : "";
  const list = await get_list<AlarmList, Alarm>(`/v1/alarms?all=true${query}`, (part) => part.alarms);
  const now = known(list.all, new Map());
  const next = new Map(loop ? defined.peek() : []);
  if (loop) next.set(loop, []);
  for (const alarm of now) {
    const of_loop = next.get(alarm.loop);
    if (of_loop) of_loop.push(alarm);
    else next.set(alarm.loop, [alarm]);
  }
  for (const list of next.values()) list.sort((a, b) => a.name.localeCompare(b.name));
  defined.value = next;
}

/** A level as it is drawn: on a bar, in a trend. */
export interface Limit {
  at: number;
  name: string;
  kind: string;
  priority: Priority;
  /** Does its alarm stand? */
  on: boolean;
}

/** The levels of a loop's port; of its measured port where none is named. */
export function limits_of(loop: string, port?: string): Limit[] {
  const spec = loops.value.get(loop)?.spec.value;
  const measured = spec?.measured_port ?? "";
  const wanted = port ?? measured;
  const now = new Map(alarms_of(loop).map((alarm) => [alarm.name, alarm]));
  return (defined.value.get(loop) ?? []).flatMap((alarm) => {
    const { kind, limit } = alarm.definition;
    if (!LEVELS.includes(kind) || limit === null || limit === undefined || (alarm.definition.port ?? measured) !== wanted) return [];
    const current = now.get(alarm.name);
    return [{ at: limit, name: alarm.name, kind, priority: alarm.definition.priority, on: current !== undefined && stands(current) && !current.quiet }];
  });
}

const path = (alarm: { loop: string; name: string }): string => `/v1/loops/${encodeURIComponent(alarm.loop)}/alarms/${encodeURIComponent(alarm.name)}`;

/** What a person does with an alarm. */
export async function act(alarm: { loop: string; name: string }, what: string, more: { note?: string; reason?: string; seconds?: number } = {}): Promise<void> {
  await send<Alarm>("POST", path(alarm), { act: what, by: by(), ...more });
  await Promise.all([load_alarms(), load_defined(alarm.loop)]);
}

/** Defines an alarm or changes its definition. */
export async function define(alarm: { loop: string; name: string }, definition: AlarmDefinition): Promise<void> {
  await send<Alarm>("PUT", path(alarm), definition);
  await Promise.all([load_alarms(), load_defined(alarm.loop)]);
}

/** Takes an alarm's definition away. */
export async function undefine(alarm: { loop: string; name: string }): Promise<void> {
  await remove(path(alarm));
  await Promise.all([load_alarms(), load_defined(alarm.loop)]);
}

// The sound

const SOUND_KEY = "bumpless.sound";
/** Pause between two tones while an urgent alarm waits for a person, in ms. */
const REPEAT_MS = 10_000;

function stored_sound(): boolean {
  try {
    return localStorage.getItem(SOUND_KEY) === "on";
  } catch {
    return false;
  }
}

/** Off unless somebody turned it on here: a page on a wall must not shout because it was reloaded. */
export const sound = signal(stored_sound());
let audio: AudioContext | null = null;

export function set_sound(on: boolean): void {
  sound.value = on;
  try {
    if (on) localStorage.setItem(SOUND_KEY, "on");
    else localStorage.removeItem(SOUND_KEY);
  } catch {
    // Storage may be forbidden; the choice then lasts as long as the page.
  }
  // A browser lets sound begin with a press only; this is one.
  if (on) tone("low");
}

/** Two short notes; the more urgent the higher. */
function tone(priority: Priority): void {
  try {
    audio ??= new AudioContext();
    void audio.resume();
    const [first, second] = { high: [880, 1_175], medium: [660, 784], low: [523, 523] }[priority] as [number, number];
    for (const [n, frequency] of [first, second].entries()) {
      const from = audio.currentTime + n * 0.18;
      const note = audio.createOscillator();
      const loudness = audio.createGain();
      note.type = "triangle";
      note.frequency.value = frequency;
      loudness.gain.setValueAtTime(0, from);
      loudness.gain.linearRampToValueAtTime(0.25, from + 0.02);
      loudness.gain.exponentialRampToValueAtTime(0.001, from + 0.17);
      note.connect(loudness).connect(audio.destination);
      note.start(from);
      note.stop(from + 0.18);
    }
  } catch {
    // A machine without sound shows its alarms all the same.
  }
}

const heard = new Set<string>();
let last_tone = 0;
effect(() => {
  const now = unseen.value;
  const fresh = now.filter((alarm) => !heard.has(`${key_of(alarm)} ${alarm.comings}`));
  if (heard.size > 10_000) heard.clear();
  for (const alarm of now) heard.add(`${key_of(alarm)} ${alarm.comings}`);
  const most = fresh[0];
  if (most && sound.peek() && link.peek() === "live") {
    last_tone = performance.now();
    tone(most.priority);
  }
});
setInterval(() => {
  if (sound.peek() && link.peek() === "live" && unseen.peek().some((alarm) => alarm.priority === "high") && performance.now() - last_tone > REPEAT_MS) {
    last_tone = performance.now();
    tone("high");
  }
}, 1_000);

let looked = 0;
/** Begins to look. */
export function follow_alarms(): void {
  effect(() => {
    if (link.value !== "live") return;
    void load_alarms();
    if (loops.peek().size <= DEFINED_LOOPS_MAX) load_defined().catch(() => undefined);
  });
  effect(() => {
    const changes = alarm_news.value;
    if (changes.length === 0) return;
    looked = performance.now();
    void load_alarms();
    for (const loop of new Set(changes.filter((change) => change.what === "defined" || change.what === "removed").map((change) => change.loop))) {
      load_defined(loop).catch(() => undefined);
    }
  });
  setInterval(() => {
    if (document.hidden || link.peek() !== "live" || performance.now() - looked < LOOK_MS) return;
    looked = performance.now();
    void load_alarms();
  }, 500);
}
