// Points: values as their I/O hosts have them, who writes them, and what a person does by hand: force, free, write.
//
// A forced point is said wherever it or its loop is shown; a force has a reason, a name and an end.

import { signal } from "@preact/signals";
import { useEffect, useState } from "preact/hooks";
import { limits_of } from "./alarms";
import { send } from "./api";
import { clock, duration_us, number, span_s, value, when } from "./format";
import { forced, load_points, loops, points } from "./live";
import { Jobs } from "./jobs";
import { NameField } from "./name";
import type { Point } from "./types";
import { Act, Bar, Dialog, None, say } from "./ui";
import { by } from "./who";

const filter = signal("");
const only_forced = signal(false);

const path = (point: string, what: string): string => `/v1/points/${encodeURIComponent(point)}/${what}`;

/** What holds a point, in words. */
export function force_words(point: Point): string {
  const { force } = point;
  if (!force) return "";
  const span = point.range[1] - point.range[0];
  return `forced to ${value(force.value, span)} ${point.unit} until ${when(force.until_unix_ms)} by ${force.by || "nobody named"}: ${force.why}`;
}

/** Frees a point; with an undo as long as its time would have run. */
export async function unforce(point: Point): Promise<void> {
  const { force } = point;
  await send("POST", path(point.name, "unforce"), { by: by() });
  await load_points();
  say(
    `${point.name} is free.`,
    force && force.value !== null
      ? async () => {
          const seconds = Math.max(1, Math.round((force.until_unix_ms - Date.now()) / 1_000));
          await send("POST", path(point.name, "force"), { value: force.value, seconds, by: by(), why: force.why });
          await load_points();
        }
      : undefined,
  );
}

export function Points(props: { tab: string }) {
  const tab = props.tab === "jobs" ? "jobs" : "";
  return (
    <>
      <div class="head">
        <h1>Points</h1>
        <p class="quiet">
          {points.value.size} points{forced.value.length > 0 && `, ${forced.value.length} forced`}
        </p>
        {tab === "" && (
          <div class="row end grow wrap">
            <label class="check">
              <input type="checkbox" checked={only_forced.value} onChange={(event) => (only_forced.value = event.currentTarget.checked)} /> only forced
            </label>
            <input type="search" class="short" placeholder="filter" aria-label="Filter points" value={filter.value} onInput={(event) => (filter.value = event.currentTarget.value)} />
          </div>
        )}
      </div>
      <nav class="tabs" aria-label="Points, buses and jobs">
        <a href="#/points" aria-current={tab === "" ? "page" : undefined}>
          Points
        </a>
        <a href="#/points/jobs" aria-current={tab === "jobs" ? "page" : undefined}>
          Buses and jobs
        </a>
      </nav>
      {tab === "jobs" ? <Jobs /> : <Table />}
    </>
  );
}

function Table() {
  const [open, set_open] = useState<{ point: string; what: "force" | "write" } | null>(null);
  useEffect(() => {
    void load_points();
    const every = setInterval(() => {
      if (!document.hidden) void load_points();
    }, 1_000);
    return () => clearInterval(every);
  }, []);
  const wanted = filter.value.trim().toLowerCase();
  const shown = [...points.value.values()].filter(
    (point) => (!only_forced.value || point.force) && `${point.name} ${point.text} ${point.written_by ?? ""} ${point.force?.why ?? ""} ${point.force?.by ?? ""}`.toLowerCase().includes(wanted),
  );
  const readers = new Map<string, [string, string][]>();
  for (const loop of loops.value.values()) {
    for (const [port, point] of Object.entries(loop.spec.value?.spec.ports ?? {})) readers.set(point, [...(readers.get(point) ?? []), [loop.name, port]]);
  }
  const chosen = open ? points.value.get(open.point) : undefined;
  return (
    <>
      <div class="scroll" tabIndex={0} role="region" aria-label="Table of points">
        <table class="list stack points">
          <thead>
            <tr>
              <th>Point</th>
              <th class="num">Value</th>
              <th>In range</th>
              <th>Quality</th>
              <th class="num">Age</th>
              <th>Loops</th>
              <th>Host, bus</th>
              <th>By hand</th>
            </tr>
          </thead>
          <tbody>
            {shown.map((point) => {
              const span = point.range[1] - point.range[0];
              const of_loops = readers.get(point.name) ?? [];
              return (
                <tr key={point.name} class={point.force ? "forced" : ""}>
                  <th scope="row">
                    {point.name}
                    <br />
                    <small>{point.text}</small>
                  </th>
                  <td class="num">
                    {value(point.value, span)} <small>{point.unit}</small>
                  </td>
                  <td class="barcell">
                    <Bar
                      label={point.name}
                      kind={point.writable ? "out" : "pv"}
                      at={point.value}
                      low={point.range[0]}
                      high={point.range[1]}
                      unit={point.unit}
                      limits={of_loops.flatMap(([loop, port]) => limits_of(loop, port))}
                    />
                  </td>
                  <td class={point.quality === "bad" ? "urgent-text" : point.quality === "uncertain" ? "warn-text" : ""} title={point.reason}>
                    {point.quality}
                    {point.reason && <small> {point.reason}</small>}
                  </td>
                  <td class="num spare">{point.age_ms > 86_400_000 ? "–" : duration_us(point.age_ms * 1_000)}</td>
                  <td>
                    {of_loops.map(([loop, port]) => (
                      <a key={`${loop} ${port}`} class="of-loop" href={`#/loop/${loop}`}>
                        {loop} <small>{point.written_by === loop ? "writes it" : port}</small>
                      </a>
                    ))}
                  </td>
                  <td class="spare">
                    {point.host}, {point.bus}
                  </td>
                  <td class="acts">
                    {point.force && (
                      <p class="force-words">
                        <span class="tag forced">forced</span> to {value(point.force.value, span)} {point.unit} until {clock(point.force.until_unix_ms)} by {point.force.by || "nobody named"}: {point.force.why}
                      </p>
                    )}
                    {point.force && (
                      <Act class="small" label={`Free ${point.name}`} act={() => unforce(point)}>
                        Free
                      </Act>
                    )}
                    <button type="button" class="small" aria-label={`Force ${point.name}`} onClick={() => set_open({ point: point.name, what: "force" })}>
                      {point.force ? "Force anew…" : "Force…"}
                    </button>
                    {point.writable && !point.written_by && !point.force && (
                      <button type="button" class="small" aria-label={`Write ${point.name}`} onClick={() => set_open({ point: point.name, what: "write" })}>
                        Write…
                      </button>
                    )}
                  </td>
                </tr>
              );
            })}
          </tbody>
        </table>
      </div>
      {shown.length === 0 && <None what="No points." />}
      {chosen && open?.what === "force" && <Force key={`force ${chosen.name}`} point={chosen} close={() => set_open(null)} />}
      {chosen && open?.what === "write" && <Write key={`write ${chosen.name}`} point={chosen} close={() => set_open(null)} />}
    </>
  );
}

/** At most a day, in s. */
const TIMES: number[] = [60, 600, 3_600, 14_400, 28_800, 86_400];

/** What the others who look at the plant must know: who holds which point, at what, for how long, and why. */
export function Force({ point, close }: { point: Point; close: () => void }) {
  const [text, set_text] = useState("");
  const [why, set_why] = useState("");
  const [seconds, set_seconds] = useState(600);
  const [typed, set_typed] = useState("");
  const [low, high] = point.range;
  const next = number(text);
  const outside = next !== null && (next < low || next > high);
  const of_loop = point.written_by;
  const ready = next !== null && !outside && why.trim() !== "" && (!of_loop || typed === point.name);
  return (
    <Dialog title={`Force ${point.name}`} close={close}>
      <p>
        {point.writable
          ? of_loop
            ? `The actuator gets this value whatever ${of_loop} commits. The loop goes on and does not know better.`
            : "The actuator gets this value until the time is over."
          : "Every loop that reads the point gets this value, with the quality “forced”, instead of what the instrument says."}
      </p>
      <label class="field">
        <span>
          Value now <b>{value(point.value, high - low)}</b> {point.unit}
        </span>
        <input inputMode="decimal" aria-label="Value to hold" aria-invalid={outside} placeholder={`${value(low, high - low)} to ${value(high, high - low)} ${point.unit}`} value={text} onInput={(event) => set_text(event.currentTarget.value)} />
      </label>
      <label class="field">
        <span>For how long; it ends by itself</span>
        <select value={String(seconds)} onChange={(event) => set_seconds(Number(event.currentTarget.value))}>
          {TIMES.map((s) => (
            <option key={s} value={String(s)}>
              {span_s(s)}
            </option>
          ))}
        </select>
      </label>
      <label class="field">
        <span>Why</span>
        <input value={why} maxLength={500} placeholder="the next shift will ask" onInput={(event) => set_why(event.currentTarget.value)} />
      </label>
      <NameField />
      {of_loop && (
        <label class="field">
          <span>
            It overrides the loop {of_loop}: type <b>{point.name}</b> to go on
          </span>
          <input autocomplete="off" value={typed} onInput={(event) => set_typed(event.currentTarget.value)} />
        </label>
      )}
      <div class="row end">
        <button type="button" onClick={close}>
          Cancel
        </button>
        <Act
          class="danger"
          off={!ready}
          act={async () => {
            await send("POST", path(point.name, "force"), { value: next, seconds, by: by(), why });
            await load_points();
            say(`${point.name} is forced to ${value(next, high - low)} ${point.unit} for ${span_s(seconds)}.`, async () => {
              await send("POST", path(point.name, "unforce"), { by: by() });
              await load_points();
            });
            close();
          }}
        >
          Force
        </Act>
      </div>
    </Dialog>
  );
}

function Write({ point, close }: { point: Point; close: () => void }) {
  const [text, set_text] = useState("");
  const [low, high] = point.range;
  const next = number(text);
  const outside = next !== null && (next < low || next > high);
  return (
    <Dialog title={`Write ${point.name}`} close={close}>
      <p>No loop writes this point. It keeps what is written.</p>
      <label class="field">
        <span>
          Value now <b>{value(point.value, high - low)}</b> {point.unit}
        </span>
        <input inputMode="decimal" aria-label="Value to write" aria-invalid={outside} placeholder={`${value(low, high - low)} to ${value(high, high - low)} ${point.unit}`} value={text} onInput={(event) => set_text(event.currentTarget.value)} />
      </label>
      <NameField />
      <div class="row end">
        <button type="button" onClick={close}>
          Cancel
        </button>
        <Act
          class="primary"
          off={next === null || outside}
          act={async () => {
            const before = point.value;
            await send("POST", path(point.name, "write"), { value: next, by: by() });
            await load_points();
            say(`${point.name}: ${value(next, high - low)} ${point.unit} written.`, before === null ? undefined : () => send("POST", path(point.name, "write"), { value: before, by: by() }));
            close();
          }}
        >
          Write
        </Act>
      </div>
    </Dialog>
  );
}
