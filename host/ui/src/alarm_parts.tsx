// Parts of alarms that several views share: the mark of a priority, the header's count, the dialog of one alarm, its definition.
//
// A priority is told three times, by shape, by number and by colour (ISA-101): filled while nobody has seen it, outlined after.

import { useEffect, useState } from "preact/hooks";
import { act, alarms, alarms_of, define, defined, has_limit, is_unseen, key_of, KINDS, type Known, load_defined, PRIORITIES, RANK, says, scale_of, STATE, stands, told, undefine, unseen } from "./alarms";
import { get } from "./api";
import { ago, clock, number, value, when } from "./format";
import { loops } from "./live";
import type { Alarm, AlarmChange, AlarmDefinition, Priority } from "./types";
import { Act, complain, Dialog, say } from "./ui";
import { NameField } from "./name";

const SHAPES: Record<Priority, string> = {
  high: "M2.5 2.5h15v15h-15z",
  medium: "M10 1.5 19 17.5H1z",
  low: "M10 1a9 9 0 1 0 .01 0z",
};

/** The mark of a priority; with an empty label for those who do not see it, where words beside it say the same. */
export function Prio({ priority, seen, label }: { priority: Priority; seen?: boolean; label?: string }) {
  return (
    <svg class={`prio ${priority}${seen ? " seen" : ""}`} viewBox="0 0 20 20" role={label === "" ? undefined : "img"} aria-hidden={label === "" ? true : undefined} aria-label={label === "" ? undefined : (label ?? `${priority} priority`)}>
      <path d={SHAPES[priority]} />
      <text x="10" y={priority === "medium" ? 15.5 : 14.3} text-anchor="middle">
        {RANK[priority]}
      </text>
    </svg>
  );
}

/** The header's count: of what nobody has seen, else of what stands. */
export function Bell() {
  const waiting = unseen.value;
  const standing = told.value.length;
  const by_priority = PRIORITIES.map((priority) => [priority, waiting.filter((alarm) => alarm.priority === priority).length] as const).filter(([, n]) => n > 0);
  const words =
    waiting.length > 0
      ? `${waiting.length} ${waiting.length === 1 ? "alarm" : "alarms"} not acknowledged: ${by_priority.map(([priority, n]) => `${n} ${priority}`).join(", ")}`
      : standing > 0
        ? `${standing} ${standing === 1 ? "alarm stands" : "alarms stand"}, all acknowledged`
        : "no alarms";
  const most = by_priority[0]?.[0] ?? "";
  return (
    <>
      <a class={`bell ${waiting.length > 0 ? `waiting ${most}` : standing > 0 ? "seen" : "none"}`} href="#/alarms" title={words}>
        <span aria-hidden="true">
          {by_priority.map(([priority, n]) => (
            <span key={priority}>
              <Prio priority={priority} label="" /> {n}
            </span>
          ))}
          {waiting.length === 0 && (standing > 0 ? `${standing} seen` : "no alarms")}
        </span>
        <span class="hidden">{words}</span>
      </a>
      <span class="hidden" role="status">
        {words}
      </span>
    </>
  );
}

/** How an alarm stands, in a word and by its look. */
export function StateWord({ alarm }: { alarm: Alarm }) {
  return (
    <span class={`state ${alarm.state}`}>
      {STATE[alarm.state]}
      {alarm.shelf && <small> shelved</small>}
      {alarm.suppressed && <small> suppressed by {alarm.definition.suppressed_by}</small>}
      {alarm.out_of_service && <small> out of service</small>}
    </span>
  );
}

export const acknowledge = async (alarm: Known, note = ""): Promise<void> => {
  await act(alarm, "acknowledge", { note });
  say(`${alarm.loop} ${alarm.name}: acknowledged`);
};

export const reset = async (alarm: Known): Promise<void> => {
  await act(alarm, "reset");
  say(`${alarm.loop} ${alarm.name}: reset`);
};

export const unshelve = async (alarm: Known): Promise<void> => {
  const shelf = alarm.shelf;
  await act(alarm, "unshelve");
  say(`${alarm.loop} ${alarm.name}: told again`, shelf ? () => act(alarm, "shelve", { seconds: Math.max(1, shelf.seconds_left), reason: shelf.reason }) : undefined);
};

export const put_back = async (alarm: Known): Promise<void> => {
  const reason = alarm.out_of_service ?? "";
  await act(alarm, "put-back");
  say(`${alarm.loop} ${alarm.name}: back in service`, () => act(alarm, "take-out", { reason }));
};

/** At most one shift, in s. */
const SHELVES: [string, number][] = [
  ["15 minutes", 900],
  ["30 minutes", 1_800],
  ["1 hour", 3_600],
  ["2 hours", 7_200],
  ["4 hours", 14_400],
  ["8 hours", 28_800],
  ["12 hours, a shift", 43_200],
];

/** Everything about one alarm, and what can be done with it. */
export function AlarmDialog(props: { loop: string; name: string; close: () => void }) {
  const [note, set_note] = useState("");
  const [reason, set_reason] = useState("");
  const [seconds, set_seconds] = useState(1_800);
  const [edit, set_edit] = useState(false);
  const [past, set_past] = useState<AlarmChange[]>([]);
  const key = key_of(props);
  const alarm = alarms.value.find((one) => key_of(one) === key) ?? defined.value.get(props.loop)?.find((one) => one.name === props.name);
  useEffect(() => {
    load_defined(props.loop).catch(complain);
  }, [props.loop]);
  const comings = alarm ? `${alarm.comings} ${alarm.state}` : "";
  useEffect(() => {
    get<{ changes: AlarmChange[] }>(`/v1/alarms/history?limit=1000&loop=${encodeURIComponent(props.loop)}`).then(
      (list) => set_past(list.changes.filter((change) => change.alarm === props.name).slice(0, 12)),
      complain,
    );
  }, [key, comings]);
  if (!alarm) {
    return (
      <Dialog title={`${props.loop} ${props.name}`} close={props.close}>
        <p>This alarm is not defined any more.</p>
      </Dialog>
    );
  }
  if (edit) return <AlarmForm loop={alarm.loop} alarm={alarm} close={() => set_edit(false)} />;
  const { definition } = alarm;
  const { span } = scale_of(alarm.loop, definition);
  return (
    <Dialog title={`${alarm.loop}: ${alarm.name}`} close={props.close}>
      <p class="row wrap">
        <Prio priority={alarm.priority} seen={!is_unseen(alarm)} /> <b>{says(alarm)}</b>
        {alarm.first_out && <span class="tag warn">first of {definition.group}</span>}
      </p>
      <dl>
        <dt>State</dt>
        <dd>
          <StateWord alarm={alarm} />
        </dd>
        <dt>Came</dt>
        <dd>{alarm.came_unix_ms === null ? "never" : `${when(alarm.came_unix_ms)}, ${ago(alarm.came_unix_ms)}; ${alarm.comings} ${alarm.comings === 1 ? "time" : "times"} in all`}</dd>
        {alarm.acknowledged_by && (
          <>
            <dt>Seen by</dt>
            <dd>
              {alarm.acknowledged_by}
              {alarm.note && `: ${alarm.note}`}
            </dd>
          </>
        )}
        {alarm.shelf && (
          <>
            <dt>Shelved</dt>
            <dd>
              until {clock(alarm.shelved_until_unix_ms ?? 0)} by {alarm.shelf.by || "nobody named"}: {alarm.shelf.reason}
            </dd>
          </>
        )}
        {alarm.out_of_service && (
          <>
            <dt>Out of service</dt>
            <dd>{alarm.out_of_service}</dd>
          </>
        )}
        <dt>Cause</dt>
        <dd>{definition.cause || <i class="quiet">nobody wrote it down</i>}</dd>
        <dt>Consequence</dt>
        <dd>{definition.consequence || <i class="quiet">nobody wrote it down</i>}</dd>
        <dt>What to do</dt>
        <dd>{definition.response ? <b>{definition.response}</b> : <i class="quiet">nobody wrote it down</i>}</dd>
      </dl>
      <NameField />
      {is_unseen(alarm) && (
        <div class="enter">
          <label class="field">
            <span>Note</span>
            <input value={note} maxLength={500} placeholder="optional" onInput={(event) => set_note(event.currentTarget.value)} />
          </label>
          <Act class="primary" act={async () => { await acknowledge(alarm, note); set_note(""); }}>
            Acknowledge
          </Act>
        </div>
      )}
      {alarm.state === "latched" && (
        <Act class="primary" act={() => reset(alarm)}>
          Reset
        </Act>
      )}
      {alarm.shelf ? (
        <Act act={() => unshelve(alarm)}>Unshelve</Act>
      ) : alarm.out_of_service ? (
        <Act act={() => put_back(alarm)}>Put back into service</Act>
      ) : (
        <fieldset class="quieten">
          <legend>Keep it quiet</legend>
          <label class="field">
            <span>Reason</span>
            <input value={reason} maxLength={500} placeholder="the next shift will ask" onInput={(event) => set_reason(event.currentTarget.value)} />
          </label>
          <div class="enter three">
            <label class="field">
              <span>For</span>
              <select value={String(seconds)} onChange={(event) => set_seconds(Number(event.currentTarget.value))}>
                {SHELVES.map(([words, s]) => (
                  <option key={s} value={String(s)}>
                    {words}
                  </option>
                ))}
              </select>
            </label>
            <Act
              off={reason.trim() === ""}
              title={reason.trim() === "" ? "with a reason" : ""}
              act={async () => {
                await act(alarm, "shelve", { seconds, reason });
                say(`${alarm.loop} ${alarm.name}: shelved until ${clock(Date.now() + seconds * 1_000)}`, () => act(alarm, "unshelve"));
                set_reason("");
              }}
            >
              Shelve
            </Act>
            <Act
              off={reason.trim() === ""}
              title={reason.trim() === "" ? "with a reason" : "until somebody puts it back"}
              act={async () => {
                await act(alarm, "take-out", { reason });
                say(`${alarm.loop} ${alarm.name}: out of service`, () => act(alarm, "put-back"));
                set_reason("");
              }}
            >
              Take out of service
            </Act>
          </div>
        </fieldset>
      )}
      {past.length > 0 && (
        <details>
          <summary>What happened to it</summary>
          <ol class="events" tabIndex={0}>
            {past.map((change) => (
              <li key={`${change.at_unix_us} ${change.what}`}>
                <time>{when(change.at_unix_us / 1_000)}</time>
                <span>
                  {change.what}
                  {change.value !== null && ` at ${value(change.value, span)}`}
                  {change.by && ` by ${change.by}`}
                  {change.note && `: ${change.note}`}
                </span>
              </li>
            ))}
          </ol>
        </details>
      )}
      <div class="row end">
        {location.hash !== `#/loop/${alarm.loop}` && (
          <a class="button" href={`#/loop/${alarm.loop}`} onClick={props.close}>
            To the loop
          </a>
        )}
        {definition.kind !== "controller" && (
          <button type="button" onClick={() => set_edit(true)}>
            Definition…
          </button>
        )}
      </div>
    </Dialog>
  );
}

const OF_LEVELS = ["hi-hi", "hi", "lo", "lo-lo", "deviation", "rate", "bad-quality"];
const OF_LOOPS = ["fault", "overrun", "redundancy-lost", "dissent"];

const FRESH: AlarmDefinition = { kind: "hi", dead_band: 0, on_delay_s: 0, off_delay_s: 0, priority: "medium", latching: false, cause: "", consequence: "", response: "" };

/** An alarm's definition, with the words that make it rational (ISA-18.2): cause, consequence, what to do. */
export function AlarmForm(props: { loop: string; alarm?: Known; close: () => void }) {
  const base = props.alarm?.definition ?? FRESH;
  const [name, set_name] = useState(props.alarm?.name ?? "");
  const [draft, set_draft] = useState<AlarmDefinition>(base);
  const [texts, set_texts] = useState({
    limit: base.limit === null || base.limit === undefined ? "" : String(base.limit),
    dead_band: String(base.dead_band),
    on_delay_s: String(base.on_delay_s),
    off_delay_s: String(base.off_delay_s),
  });
  const put = (part: Partial<AlarmDefinition>): void => set_draft({ ...draft, ...part });
  const type = (part: Partial<typeof texts>): void => set_texts({ ...texts, ...part });
  const spec = loops.value.get(props.loop)?.spec.value;
  const others = (defined.value.get(props.loop) ?? []).filter((one) => one.name !== name);
  const { unit, low, high, span } = scale_of(props.loop, draft);
  const of_port = OF_LEVELS.includes(draft.kind);
  const wants_limit = has_limit(draft.kind);
  const numbers = { limit: number(texts.limit), dead_band: number(texts.dead_band), on_delay_s: number(texts.on_delay_s), off_delay_s: number(texts.off_delay_s) };
  const missing =
    !/^[A-Za-z0-9._-]{1,64}$/.test(name) ? "the name has 1 to 64 of a-z A-Z 0-9 . _ -"
    : props.alarm === undefined && others.some((one) => one.name === name) ? "the loop has an alarm of that name"
    : wants_limit && numbers.limit === null ? "the limit is missing"
    : numbers.dead_band === null || numbers.dead_band < 0 ? "the dead band is 0 or more"
    : [numbers.on_delay_s, numbers.off_delay_s].some((s) => s === null || s < 0 || s > 3_600) ? "delays are 0 to 3600 s"
    : "";
  const save = async (): Promise<void> => {
    const target = { loop: props.loop, name };
    await define(target, {
      ...draft,
      port: of_port ? draft.port || null : null,
      limit: wants_limit ? numbers.limit : null,
      dead_band: numbers.dead_band ?? 0,
      on_delay_s: numbers.on_delay_s ?? 0,
      off_delay_s: numbers.off_delay_s ?? 0,
      group: draft.group || null,
      suppressed_by: draft.suppressed_by || null,
    });
    const before = props.alarm?.definition;
    say(`${props.loop} ${name}: ${before ? "changed" : "defined"}`, () => (before ? define(target, before) : undefine(target)));
    props.close();
  };
  return (
    <Dialog title={props.alarm ? `${props.loop}: ${props.alarm.name}, definition` : `New alarm of ${props.loop}`} close={props.close} wide>
      <div class="grid3">
        <label class="field">
          <span>Name</span>
          <input value={name} disabled={props.alarm !== undefined} placeholder="high" onInput={(event) => set_name(event.currentTarget.value)} />
        </label>
        <label class="field">
          <span>It comes when</span>
          <select value={draft.kind} onChange={(event) => put({ kind: event.currentTarget.value })}>
            <optgroup label="a value is">
              {OF_LEVELS.map((kind) => (
                <option key={kind} value={kind}>
                  {KINDS[kind]} ({kind})
                </option>
              ))}
            </optgroup>
            <optgroup label="the loop">
              {OF_LOOPS.map((kind) => (
                <option key={kind} value={kind}>
                  {KINDS[kind]}
                </option>
              ))}
            </optgroup>
          </select>
        </label>
        <label class="field">
          <span>Priority</span>
          <select value={draft.priority} onChange={(event) => put({ priority: event.currentTarget.value as Priority })}>
            {PRIORITIES.map((priority) => (
              <option key={priority}>{priority}</option>
            ))}
          </select>
        </label>
        {of_port && (
          <label class="field">
            <span>Port</span>
            <select value={draft.port ?? ""} onChange={(event) => put({ port: event.currentTarget.value || null })}>
              <option value="">{spec?.measured_port ?? "the measured one"} (measured)</option>
              {Object.keys(spec?.spec.ports ?? {})
                .filter((port) => port !== spec?.measured_port)
                .map((port) => (
                  <option key={port}>{port}</option>
                ))}
            </select>
          </label>
        )}
        {wants_limit && (
          <>
            <label class="field">
              <span>Limit{unit && `, ${unit}`}</span>
              <input inputMode="decimal" value={texts.limit} placeholder={draft.kind === "deviation" || draft.kind === "rate" ? "more than 0" : `${value(low, span)} to ${value(high, span)}`} onInput={(event) => type({ limit: event.currentTarget.value })} />
            </label>
            <label class="field">
              <span>Dead band{unit && `, ${unit}`}</span>
              <input inputMode="decimal" value={texts.dead_band} onInput={(event) => type({ dead_band: event.currentTarget.value })} />
            </label>
          </>
        )}
        <label class="field">
          <span>Must hold for, s</span>
          <input inputMode="decimal" value={texts.on_delay_s} onInput={(event) => type({ on_delay_s: event.currentTarget.value })} />
        </label>
        <label class="field">
          <span>Must be gone for, s</span>
          <input inputMode="decimal" value={texts.off_delay_s} onInput={(event) => type({ off_delay_s: event.currentTarget.value })} />
        </label>
        <label class="field">
          <span>Group, its first is marked</span>
          <input value={draft.group ?? ""} placeholder="none" onInput={(event) => put({ group: event.currentTarget.value })} />
        </label>
        <label class="field">
          <span>Quiet while this one stands</span>
          <select value={draft.suppressed_by ?? ""} onChange={(event) => put({ suppressed_by: event.currentTarget.value || null })}>
            <option value="">none</option>
            {others.map((one) => (
              <option key={one.name}>{one.name}</option>
            ))}
          </select>
        </label>
        <label class="check sit">
          <input type="checkbox" checked={draft.latching} onChange={(event) => put({ latching: event.currentTarget.checked })} /> stays until a person resets it
        </label>
      </div>
      {(
        [
          ["cause", "Cause: what leads to it"],
          ["consequence", "Consequence: what follows if nobody acts"],
          ["response", "What the operator is to do"],
        ] as const
      ).map(([field, words]) => (
        <label key={field} class="field">
          <span>{words}</span>
          <textarea rows={2} maxLength={512} value={draft[field]} onInput={(event) => put({ [field]: event.currentTarget.value })} />
        </label>
      ))}
      <p class="hint">{missing || "Changing an alarm does not touch the loop."}</p>
      <div class="row end">
        {props.alarm && (
          <Act
            class="danger"
            act={async () => {
              const target = { loop: props.loop, name };
              await undefine(target);
              say(`${props.loop} ${name}: removed`, () => define(target, base));
              props.close();
            }}
          >
            Remove
          </Act>
        )}
        <button type="button" onClick={props.close}>
          Cancel
        </button>
        <Act class="primary" off={missing !== ""} act={save}>
          {props.alarm ? "Change" : "Define"}
        </Act>
      </div>
    </Dialog>
  );
}

/** The alarms of one loop on its faceplate. */
export function LoopAlarms({ loop }: { loop: string }) {
  const [open, set_open] = useState("");
  const [fresh, set_fresh] = useState(false);
  useEffect(() => {
    load_defined(loop).catch(complain);
  }, [loop]);
  const now = new Map(alarms_of(loop).map((alarm) => [alarm.name, alarm]));
  const list = (defined.value.get(loop) ?? []).map((alarm) => now.get(alarm.name) ?? { ...alarm, state: now.has(alarm.name) ? alarm.state : ("normal" as const) });
  list.sort((a, b) => Number(stands(b)) - Number(stands(a)) || RANK[a.priority] - RANK[b.priority] || a.name.localeCompare(b.name));
  return (
    <section class="panel" aria-label={`Alarms of ${loop}`}>
      <div class="row">
        <h2 class="grow">Alarms</h2>
        <button type="button" class="small" onClick={() => set_fresh(true)}>
          New alarm…
        </button>
      </div>
      <ul class="alarm-list">
        {list.map((alarm) => {
          const { unit, span } = scale_of(loop, alarm.definition);
          const quiet = alarm.shelf ? "shelved" : alarm.out_of_service ? "out of service" : alarm.suppressed ? "suppressed" : "";
          return (
            <li key={alarm.name} class={alarm.state === "normal" || alarm.quiet ? "" : "on"}>
              <button type="button" class="plain" onClick={() => set_open(alarm.name)}>
                <Prio priority={alarm.priority} seen={!is_unseen(alarm)} label="" />
                <b aria-hidden="true">{alarm.name}</b>
                <span class="hidden">{`${alarm.name}, ${alarm.priority} priority, ${STATE[alarm.state]}`}</span>
                <span>
                  {alarm.definition.limit !== null && alarm.definition.limit !== undefined ? `${alarm.definition.kind} ${value(alarm.definition.limit, span)} ${unit}` : (KINDS[alarm.definition.kind] ?? alarm.definition.kind)}
                </span>
                <small>{quiet || (alarm.state === "normal" ? "" : STATE[alarm.state])}</small>
              </button>
            </li>
          );
        })}
      </ul>
      {open && <AlarmDialog key={open} loop={loop} name={open} close={() => set_open("")} />}
      {fresh && <AlarmForm loop={loop} close={() => set_fresh(false)} />}
    </section>
  );
}
