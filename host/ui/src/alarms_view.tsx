// The alarms: what stands, what is kept quiet, what happened, what is defined, and how the whole does.

import { signal } from "@preact/signals";
import { useEffect, useState } from "preact/hooks";
import { alarms_read, defined, floods, in_order, is_unseen, key_of, KINDS, type Known, load_defined, PRIORITIES, says, scale_of, set_sound, silent_homes, sound, STATE, told } from "./alarms";
import { acknowledge, AlarmDialog, AlarmForm, Prio, put_back, reset, StateWord, unshelve } from "./alarm_parts";
import { Load } from "./alarm_load";
import { get } from "./api";
import { ago, clock, day, value, when, zone } from "./format";
import { loops, tick } from "./live";
import type { AlarmChange, Priority } from "./types";
import { Act, complain, None, say } from "./ui";
import { act } from "./alarms";

const TABS: [string, string][] = [
  ["", "Standing"],
  ["quiet", "Kept quiet"],
  ["history", "History"],
  ["defined", "Defined"],
  ["load", "Figures"],
];
/** Rows that a table shows at most; the rest is found by filter. */
const ROWS_MAX = 400;

const filter = signal("");
const least = signal<Priority>("low");

const passes = (alarm: { loop: string; name: string; priority: Priority }, words: string): boolean =>
  PRIORITIES.indexOf(alarm.priority) <= PRIORITIES.indexOf(least.value) && `${alarm.loop} ${alarm.name} ${words}`.toLowerCase().includes(filter.value.trim().toLowerCase());

/** More than one person can take: said in every view. */
export function FloodBanner() {
  const flooding = floods.value.filter((flood) => flood.is_flood);
  if (flooding.length === 0) return null;
  return (
    <div class="banner soft" role="alert">
      <b>Alarm flood.</b> {flooding.map((flood) => `${flood.comings} alarms in ten minutes at ${flood.host}`).join("; ")}: more than ten are more than one person can take. Keep to the <a href="#/alarms">most urgent ones</a> first.
    </div>
  );
}

export function Alarms(props: { tab: string }) {
  const [open, set_open] = useState<{ loop: string; name: string } | null>(null);
  const tab = TABS.some(([id]) => id === props.tab) ? props.tab : "";
  return (
    <>
      <div class="head">
        <h1>Alarms</h1>
        <p class="quiet">times in {zone()}</p>
        <div class="row end grow wrap">
          <label class="check" title="a short tone for each new alarm, in this browser; off unless you turn it on">
            <input type="checkbox" checked={sound.value} onChange={(event) => set_sound(event.currentTarget.checked)} /> sound
          </label>
          <label class="field inline">
            <span>from priority</span>
            <select value={least.value} onChange={(event) => (least.value = event.currentTarget.value as Priority)}>
              {[...PRIORITIES].reverse().map((priority) => (
                <option key={priority}>{priority}</option>
              ))}
            </select>
          </label>
          <input type="search" class="short" placeholder="filter" aria-label="Filter alarms" value={filter.value} onInput={(event) => (filter.value = event.currentTarget.value)} />
        </div>
      </div>
      <nav class="tabs" aria-label="Kinds of alarm lists">
        {TABS.map(([id, words]) => (
          <a key={id} href={`#/alarms${id && `/${id}`}`} aria-current={tab === id ? "page" : undefined}>
            {words}
          </a>
        ))}
      </nav>
      {silent_homes.value.map((home) => (
        <p key={home.host} class="warn-text" role="status">
          {home.host} does not answer, so its alarms are not here: {home.reason}
        </p>
      ))}
      {tab === "" && <Standing open={set_open} />}
      {tab === "quiet" && <Quiet open={set_open} />}
      {tab === "history" && <Past open={set_open} />}
      {tab === "defined" && <Defined open={set_open} />}
      {tab === "load" && <Load open={set_open} />}
      {open && <AlarmDialog key={key_of(open)} loop={open.loop} name={open.name} close={() => set_open(null)} />}
    </>
  );
}

type Open = (alarm: { loop: string; name: string }) => void;

function Named({ alarm, open }: { alarm: Known; open: Open }) {
  return (
    <>
      <button type="button" class="link-button" onClick={() => open(alarm)}>
        {alarm.loop} <b>{alarm.name}</b>
      </button>
      {alarm.first_out && <span class="tag warn" title={`the first of ${alarm.definition.group ?? "its group"} that came`}>first out</span>}
      {alarm.definition.latching && <span class="tag">latching</span>}
    </>
  );
}

function Standing({ open }: { open: Open }) {
  tick.value;
  const shown = told.value.filter((alarm) => passes(alarm, says(alarm)));
  const waiting = shown.filter(is_unseen);
  return (
    <>
      <div class="row wrap above">
        <p class="grow quiet">
          {told.value.length === 0 ? (alarms_read.value ? "Nothing stands." : "Reading…") : `${told.value.length} ${told.value.length === 1 ? "stands" : "stand"} or ${told.value.length === 1 ? "waits" : "wait"} for a person, ${told.value.filter(is_unseen).length} not acknowledged`}
        </p>
        <Act
          off={waiting.length === 0}
          act={async () => {
            let done = 0;
            for (const alarm of waiting) {
              // One after the other: each is on its home's disk before the next one is asked for.
              await act(alarm, "acknowledge");
              done += 1;
            }
            say(`${done} acknowledged`);
          }}
        >
          Acknowledge all {waiting.length > 0 ? `${waiting.length} ` : ""}shown
        </Act>
      </div>
      {shown.length > 0 ? (
        <div class="scroll" tabIndex={0} role="region" aria-label="Table of alarms">
          <table class="list stack">
            <thead>
              <tr>
                <th>
                  <span class="hidden">Priority</span>
                </th>
                <th>Alarm</th>
                <th>State</th>
                <th>Came</th>
                <th>Seen by</th>
                <th>
                  <span class="hidden">What to do</span>
                </th>
              </tr>
            </thead>
            <tbody>
              {shown.slice(0, ROWS_MAX).map((alarm) => (
                <tr key={key_of(alarm)} class={`alarm ${alarm.priority}${is_unseen(alarm) ? " unseen" : ""}`}>
                  <td class="prio-cell">
                    <Prio priority={alarm.priority} seen={!is_unseen(alarm)} />
                  </td>
                  <th scope="row">
                    <Named alarm={alarm} open={open} />
                    <p>{says(alarm)}</p>
                    {alarm.definition.response && <small>{alarm.definition.response}</small>}
                  </th>
                  <td>
                    <StateWord alarm={alarm} />
                  </td>
                  <td class="when">
                    <time title={alarm.came_unix_ms === null ? "" : day(alarm.came_unix_ms)}>{alarm.came_unix_ms === null ? "–" : when(alarm.came_unix_ms)}</time>
                    <br />
                    <small>{alarm.came_unix_ms === null ? "" : ago(alarm.came_unix_ms)}</small>
                  </td>
                  <td>
                    {alarm.state === "active" || !alarm.acknowledged_by ? "" : alarm.acknowledged_by}
                    {alarm.state !== "active" && alarm.note && <small> {alarm.note}</small>}
                  </td>
                  <td class="acts">
                    {is_unseen(alarm) && (
                      <Act class="small primary" label={`Acknowledge ${alarm.loop} ${alarm.name}`} act={() => acknowledge(alarm)}>
                        Acknowledge
                      </Act>
                    )}
                    {alarm.state === "latched" && (
                      <Act class="small primary" label={`Reset ${alarm.loop} ${alarm.name}`} act={() => reset(alarm)}>
                        Reset
                      </Act>
                    )}
                    <button type="button" class="small" aria-label={`More about ${alarm.loop} ${alarm.name}`} onClick={() => open(alarm)}>
                      More…
                    </button>
                  </td>
                </tr>
              ))}
            </tbody>
          </table>
          {shown.length > ROWS_MAX && <p class="hint">The first {ROWS_MAX} of {shown.length}.</p>}
        </div>
      ) : (
        <section class="panel calm">
          <p>{told.value.length > 0 ? "None that passes the filter." : "All is as it should be: nothing stands, and nothing waits to be seen."}</p>
        </section>
      )}
    </>
  );
}

/** All definitions, read again now and then while they are looked at. */
function useDefined(): Known[] {
  useEffect(() => {
    const read = (): void => void load_defined().catch(complain);
    read();
    const every = setInterval(read, 10_000);
    return () => clearInterval(every);
  }, []);
  return [...defined.value.values()].flat();
}

function Quiet({ open }: { open: Open }) {
  tick.value;
  const shown = in_order(useDefined().filter((alarm) => alarm.quiet && passes(alarm, alarm.shelf?.reason ?? alarm.out_of_service ?? "")));
  return (
    <>
      <p class="hint above">What a person shelved or took out of service, and what another alarm explains. It goes on living, so that it is known when it comes back.</p>
      {shown.length === 0 && <None what="Nothing is kept quiet." />}
      {shown.length > 0 && (
        <div class="scroll" tabIndex={0} role="region" aria-label="Table of quiet alarms">
          <table class="list stack">
            <thead>
              <tr>
                <th>
                  <span class="hidden">Priority</span>
                </th>
                <th>Alarm</th>
                <th>State</th>
                <th>Why quiet</th>
                <th>By</th>
                <th>Until</th>
                <th>
                  <span class="hidden">What to do</span>
                </th>
              </tr>
            </thead>
            <tbody>
              {shown.map((alarm) => (
                <tr key={key_of(alarm)}>
                  <td class="prio-cell">
                    <Prio priority={alarm.priority} seen />
                  </td>
                  <th scope="row">
                    <Named alarm={alarm} open={open} />
                    <p>{says(alarm)}</p>
                  </th>
                  <td>{STATE[alarm.state]}</td>
                  <td>
                    {alarm.shelf ? `shelved: ${alarm.shelf.reason}` : alarm.out_of_service ? `out of service: ${alarm.out_of_service}` : `suppressed by ${alarm.definition.suppressed_by}`}
                  </td>
                  <td>{alarm.shelf?.by ?? ""}</td>
                  <td class="when">{alarm.shelf ? clock(alarm.shelved_until_unix_ms ?? 0) : alarm.out_of_service ? "somebody puts it back" : "that one goes"}</td>
                  <td class="acts">
                    {alarm.shelf && (
                      <Act class="small" label={`Unshelve ${alarm.loop} ${alarm.name}`} act={() => unshelve(alarm)}>
                        Unshelve
                      </Act>
                    )}
                    {alarm.out_of_service && (
                      <Act class="small" label={`Put back ${alarm.loop} ${alarm.name}`} act={() => put_back(alarm)}>
                        Put back
                      </Act>
                    )}
                  </td>
                </tr>
              ))}
            </tbody>
          </table>
        </div>
      )}
    </>
  );
}

const PAST_MAX = 1_000;

function Past({ open }: { open: Open }) {
  const [past, set_past] = useState<AlarmChange[] | null>(null);
  // What stands has changed: so has the past.
  const stands_now = told.value.map((alarm) => `${key_of(alarm)} ${alarm.state} ${alarm.comings}`).join();
  useEffect(() => {
    get<{ changes: AlarmChange[] }>(`/v1/alarms/history?limit=${PAST_MAX}`).then((list) => set_past(list.changes), complain);
  }, [stands_now]);
  const shown = (past ?? []).filter((change) => passes({ loop: change.loop, name: change.alarm, priority: change.priority }, `${change.what} ${change.by ?? ""} ${change.note}`));
  return (
    <>
      {past && shown.length === 0 && <None what="Nothing happened." />}
      {shown.length > 0 && (
        <div class="scroll" tabIndex={0} role="region" aria-label="Table of what happened">
          <table class="list stack">
            <thead>
              <tr>
                <th>When</th>
                <th>Alarm</th>
                <th>What</th>
                <th class="num">Value</th>
                <th>By</th>
                <th>Note</th>
              </tr>
            </thead>
            <tbody>
              {shown.slice(0, ROWS_MAX).map((change) => {
                const definition = defined.value.get(change.loop)?.find((one) => one.name === change.alarm)?.definition;
                const scale = definition ? scale_of(change.loop, definition) : { unit: "", span: 100 };
                return (
                  <tr key={`${change.at_unix_us} ${change.loop} ${change.alarm} ${change.what}`}>
                    <td class="when">
                      <time title={`${day(change.at_unix_us / 1_000)} ${zone(change.at_unix_us / 1_000)}`}>{when(change.at_unix_us / 1_000)}</time>
                    </td>
                    <th scope="row">
                      <Prio priority={change.priority} seen={change.what !== "came" || change.quiet} />{" "}
                      <button type="button" class="link-button" onClick={() => open({ loop: change.loop, name: change.alarm })}>
                        {change.loop} <b>{change.alarm}</b>
                      </button>
                      {change.first_out && change.what === "came" && <span class="tag warn">first out</span>}
                    </th>
                    <td>
                      {change.what}
                      {change.quiet && <small> kept quiet</small>}
                    </td>
                    <td class="num">{change.value === null ? "" : `${value(change.value, scale.span)} ${scale.unit}`}</td>
                    <td>{change.by ?? ""}</td>
                    <td>{change.note}</td>
                  </tr>
                );
              })}
            </tbody>
          </table>
          {shown.length > ROWS_MAX && <p class="hint">The last {ROWS_MAX}.</p>}
        </div>
      )}
    </>
  );
}

function Defined({ open }: { open: Open }) {
  const [fresh, set_fresh] = useState("");
  const all = useDefined();
  const shown = all.filter((alarm) => passes(alarm, `${KINDS[alarm.definition.kind] ?? ""} ${alarm.definition.response}`));
  const bare = all.filter((alarm) => alarm.definition.response === "").length;
  const names = [...loops.value.keys()].sort((a, b) => a.localeCompare(b, undefined, { numeric: true }));
  return (
    <>
      <div class="row wrap above">
        <p class="grow quiet">
          {all.length} alarms of {defined.value.size} loops{bare > 0 ? `; of ${bare} nobody wrote down what to do` : ""}
        </p>
        <label class="field inline">
          <span>New alarm of</span>
          <select value="" onChange={(event) => set_fresh(event.currentTarget.value)}>
            <option value="">choose a loop</option>
            {names.map((name) => (
              <option key={name}>{name}</option>
            ))}
          </select>
        </label>
      </div>
      <div class="scroll" tabIndex={0} role="region" aria-label="Table of definitions">
        <table class="list stack">
          <thead>
            <tr>
              <th>
                <span class="hidden">Priority</span>
              </th>
              <th>Alarm</th>
              <th>Comes when</th>
              <th>Delays</th>
              <th>What to do</th>
              <th class="num">Came</th>
            </tr>
          </thead>
          <tbody>
            {shown.slice(0, ROWS_MAX).map((alarm) => {
              const { definition } = alarm;
              const { unit, span } = scale_of(alarm.loop, definition);
              return (
                <tr key={key_of(alarm)}>
                  <td class="prio-cell">
                    <Prio priority={alarm.priority} seen />
                  </td>
                  <th scope="row">
                    <Named alarm={alarm} open={open} />
                  </th>
                  <td>
                    {KINDS[definition.kind] ?? definition.kind}
                    {definition.limit !== null && definition.limit !== undefined && `, ${value(definition.limit, span)} ${unit}`}
                    {definition.port && <small> port {definition.port}</small>}
                  </td>
                  <td>
                    {definition.on_delay_s > 0 && `${definition.on_delay_s} s on `}
                    {definition.off_delay_s > 0 && `${definition.off_delay_s} s off`}
                  </td>
                  <td>{definition.response || <span class="quiet">–</span>}</td>
                  <td class="num">{alarm.comings > 0 ? `${alarm.comings} ×` : "never"}</td>
                </tr>
              );
            })}
          </tbody>
        </table>
        {shown.length > ROWS_MAX && <p class="hint">The first {ROWS_MAX} of {shown.length}.</p>}
      </div>
      {fresh && <AlarmForm key={fresh} loop={fresh} close={() => set_fresh("")} />}
    </>
  );
}
