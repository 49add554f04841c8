// A loop's faceplate: what an operator does with it, and what an engineer changes of it.

import { useEffect, useState } from "preact/hooks";
import { limits_of } from "./alarms";
import { LoopAlarms } from "./alarm_parts";
import { Needing } from "./sign_in";
import { command, get, remove, send } from "./api";
import { abnormal } from "./overview";
import { ago, clock, duration_us, number, value, zone } from "./format";
import { actuate, type Followed, forced_ports, hosts, load_points, load_specs, loops, measure, notices, points } from "./live";
import { force_words, unforce } from "./points";
import { Redundancy, VoteState } from "./redundancy";
import { TrendView } from "./trend";
import type { Apply, Component, Loop, LoopDraft, Mode } from "./types";
import { Act, Bar, complain, Danger, None, say } from "./ui";

const STRATEGIES = ["round-robin", "random", "cpu", "latency", "p2c", "local", "shard", "vote(3)"];

const path = (loop: string, rest = ""): string => `/v1/loops/${encodeURIComponent(loop)}${rest}`;

export function Face(props: { name: string }) {
  const loop = loops.value.get(props.name);
  if (!loop) return <None what={`There is no loop ${props.name} (any more).`} />;
  return <FaceOf key={props.name} loop={loop} />;
}

function FaceOf({ loop }: { loop: Followed }) {
  const [row, spec] = [loop.row.value, loop.spec.value];
  const [info, set_info] = useState<Component | null>(null);
  const digest = spec?.digest;
  useEffect(() => {
    if (digest) get<Component>(`/v1/components/${digest}`).then(set_info, complain);
  }, [digest]);
  useEffect(() => {
    if (points.peek().size === 0) void load_points();
  }, []);
  const found = abnormal(loop);
  const held = forced_ports(spec);
  const range = measure(spec);
  const ports = row ? Object.keys(row.outputs) : [];
  const first = actuate(spec, ports[0] ?? "");
  return (
    <>
      <div class="head">
        <a class="back" href="#/" aria-label="Back to all loops">
          ←
        </a>
        <h1>{loop.name}</h1>
        <p class="quiet">
          {spec?.component} · revision {row?.revision ?? spec?.revision} · every {spec?.spec.period_ms} ms · home {spec?.home}
        </p>
        {found.map((one) => (
          <span key={one.text} class={one.grave ? "tag urgent" : "tag warn"}>
            {one.text}
          </span>
        ))}
      </div>
      {held.map(({ port, point }) => (
        <div key={port} class="banner soft forced-banner" role="status">
          <b>
            {port} is {force_words(point)}.
          </b>{" "}
          <span class="quiet">{point.name}</span>
          <Act class="small" label={`Free ${point.name}`} act={() => unforce(point)}>
            Free
          </Act>
        </div>
      ))}
      <div class="face">
        <div class="wide">
          {spec && row && (
            <TrendView loop={loop.name} ports={ports} replicas={spec.spec.replicas} period_ms={spec.spec.period_ms} measure={range} actuate={first} limits={limits_of(loop.name)} />
          )}
          <Happened loop={loop.name} />
        </div>
        <div class="side">
          <Needing role="operator" loop={loop.name}>
            <Operate loop={loop} />
            <LoopAlarms loop={loop.name} />
          </Needing>
          {spec && <Run spec={spec} loop={loop} />}
          {spec && info && <Tune spec={spec} info={info} />}
          {spec && <Redundancy key={`redundancy-${spec.revision}`} spec={spec} put={(draft) => put(spec.name, draft)} />}
          {spec && <Limits key={spec.revision} spec={spec} ports={ports} />}
          {spec && <Revisions spec={spec} />}
          {spec && <Text key={`text-${spec.revision}`} spec={spec.spec} />}
        </div>
      </div>
    </>
  );
}

/** Setpoint, mode, output. */
function Operate({ loop }: { loop: Followed }) {
  const [row, spec] = [loop.row.value, loop.spec.value];
  const [wanted, set_wanted] = useState("");
  const [outputs, set_outputs] = useState<Record<string, string>>({});
  const range = measure(spec);
  const manual = row?.mode === "manual";
  const setpoint = async (next: number): Promise<void> => {
    const before = row?.setpoint ?? null;
    await command(loop.name, "setpoint", { setpoint: next });
    set_wanted("");
    say(
      `${loop.name}: setpoint ${value(next, range.span)} ${range.unit}`,
      before === null ? undefined : () => command(loop.name, "setpoint", { setpoint: before }),
    );
  };
  const mode = async (next: Mode): Promise<void> => {
    const before = row?.mode;
    if (before === next) return;
    await command(loop.name, "mode", { mode: next });
    say(`${loop.name}: ${next}`, before && (() => command(loop.name, "mode", { mode: before })));
  };
  const typed = number(wanted);
  const outside = typed !== null && (typed < range.low || typed > range.high);
  return (
    <section class="panel operate" aria-label="Operation">
      <div class="numbers">
        <span class="big">
          {value(row?.measurement, range.span)} <small>{range.unit}</small>
        </span>
        <span class="sub">
          {spec?.measured_port ?? "pv"}{" "}
          {row?.quality === "forced" ? <span class="tag forced">FORCED</span> : row?.quality !== "good" && <b class="warn-text"> {row?.quality}</b>}
        </span>
      </div>
      <Bar label="measurement and setpoint" kind="pv" at={row?.measurement ?? null} mark={row?.setpoint} low={range.low} high={range.high} unit={range.unit} limits={limits_of(loop.name)} />
      <div class="scale">
        <span>{value(range.low, range.span)}</span>
        <span>{value(range.high, range.span)}</span>
      </div>
      <div class="segments mode" role="group" aria-label="Mode">
        <Act act={() => mode("manual")} pressed={manual}>
          Manual
        </Act>
        <Act act={() => mode("automatic")} pressed={row?.mode === "automatic"}>
          Automatic
        </Act>
      </div>
      <p class="hint">{manual ? "In manual the output is yours. Automatic goes on from where you leave it, without a step." : "Manual takes the output over where it stands, without a step."}</p>
      <form
        class="enter"
        onSubmit={(event) => {
          event.preventDefault();
          if (typed !== null && !outside) setpoint(typed).catch(complain);
        }}
      >
        <label class="field">
          <span>
            Setpoint <b>{value(row?.setpoint, range.span)}</b> {range.unit}
          </span>
          <input
            inputMode="decimal"
            aria-label="New setpoint"
            aria-invalid={outside}
            placeholder={`${value(range.low, range.span)} to ${value(range.high, range.span)} ${range.unit}`}
            value={wanted}
            onInput={(event) => set_wanted(event.currentTarget.value)}
          />
        </label>
        <Act off={typed === null || outside} act={() => setpoint(typed as number)}>
          Set
        </Act>
      </form>
      <div class="steps">
        {[-0.01, -0.001, 0.001, 0.01].map((part) => {
          const by = part * range.span;
          return (
            <Act key={part} class="small" label={`Setpoint ${part > 0 ? "up" : "down"} by ${value(Math.abs(by), range.span)} ${range.unit}`} off={row?.setpoint === null || row === null} act={() => setpoint(Math.min(range.high, Math.max(range.low, (row?.setpoint ?? 0) + by)))}>
              {part > 0 ? "+" : "−"}
              {value(Math.abs(by), range.span)}
            </Act>
          );
        })}
      </div>
      {row &&
        Object.entries(row.outputs).map(([port, held]) => {
          const out = actuate(spec, port);
          const next = number(outputs[port] ?? "");
          return (
            <div key={port} class="output">
              <div class="row">
                <span>
                  Output {port} <b>{value(held, out.span)}</b> {out.unit}
                </span>
                {forced_ports(spec).some((one) => one.port === port) && <span class="tag forced">FORCED</span>}
              </div>
              <Bar label={`output ${port}`} kind="out" at={held} low={out.low} high={out.high} unit={out.unit} limits={limits_of(loop.name, port)} />
              {manual && (
                <form
                  class="enter"
                  onSubmit={(event) => {
                    event.preventDefault();
                    if (next !== null) command(loop.name, "output", { outputs: { [port]: next } }).then(() => set_outputs({ ...outputs, [port]: "" }), complain);
                  }}
                >
                  <input inputMode="decimal" aria-label={`New output ${port}`} placeholder={`${value(out.low, out.span)} to ${value(out.high, out.span)} ${out.unit}`} value={outputs[port] ?? ""} onInput={(event) => set_outputs({ ...outputs, [port]: event.currentTarget.value })} />
                  <Act
                    off={next === null}
                    act={async () => {
                      const before = held;
                      await command(loop.name, "output", { outputs: { [port]: next } });
                      set_outputs({ ...outputs, [port]: "" });
                      say(`${loop.name}: output ${port} ${value(next, out.span)} ${out.unit}`, before === null ? undefined : () => command(loop.name, "output", { outputs: { [port]: before } }));
                    }}
                  >
                    Set
                  </Act>
                </form>
              )}
            </div>
          );
        })}
      <a class="button wide-button" href={`#/change/${loop.name}`}>
        Change the algorithm…
      </a>
    </section>
  );
}

/** Who runs it, and how. */
function Run({ spec, loop }: { spec: Loop; loop: Followed }) {
  const [row, standing] = [loop.row.value, loop.standing.value];
  const [to, set_to] = useState("");
  const others = (standing?.members ?? []).filter((name) => name !== row?.owner);
  const strategy = async (next: string): Promise<void> => {
    const before = spec.spec.strategy;
    await send("POST", path(spec.name, "/set"), { strategy: next });
    await load_specs();
    say(`${spec.name}: strategy ${next}`, async () => {
      await send("POST", path(spec.name, "/set"), { strategy: before });
      await load_specs();
    });
  };
  return (
    <section class="panel" aria-label="Running">
      <h2>Running</h2>
      <dl>
        <dt>Owner</dt>
        <dd>{row?.owner ?? "–"}</dd>
        <dt>On line</dt>
        <dd>
          {standing?.members.join(", ") || "none"} ({standing?.members.length ?? 0} of {spec.spec.replicas})
        </dd>
        <dt>Step, write</dt>
        <dd>
          {duration_us(row?.step_us)}, {duration_us(row?.committed_after_us)} after the deadline
        </dd>
        <VoteState loop={spec.name} strategy={spec.spec.strategy} />
        {standing?.lost !== null && standing?.lost !== undefined && (
          <>
            <dt>Lost cycles</dt>
            <dd>
              {standing.lost}, {standing.takeovers} takeovers
            </dd>
          </>
        )}
      </dl>
      <label class="field">
        <span>Strategy</span>
        <select value={spec.spec.strategy} onChange={(event) => void strategy(event.currentTarget.value).catch(complain)}>
          {[...new Set([...STRATEGIES, spec.spec.strategy])].map((name) => (
            <option key={name}>{name}</option>
          ))}
        </select>
      </label>
      {others.length > 0 && (
        <div class="enter">
          <label class="field">
            <span>Give the ownership to</span>
            <select value={to} onChange={(event) => set_to(event.currentTarget.value)}>
              <option value="">choose a host</option>
              {others.map((name) => (
                <option key={name}>{name}</option>
              ))}
            </select>
          </label>
          <Act
            off={!others.includes(to)}
            act={async () => {
              const before = row?.owner;
              await send("POST", path(spec.name, "/move"), { host: to });
              set_to("");
              say(`${spec.name}: ${to} owns it now`, before ? () => send("POST", path(spec.name, "/move"), { host: before }) : undefined);
            }}
          >
            Move
          </Act>
        </div>
      )}
      {spec.failures.map((failure) => (
        <p key={failure.reason} class="warn-text">
          revision {failure.revision}: {failure.reason} ({failure.tries} tries)
        </p>
      ))}
      {hosts.value.some((host) => !host.alive) && <p class="hint">Not all hosts of the cell are alive.</p>}
    </section>
  );
}

/** Parameters, all of them put in force with one cycle. */
function Tune({ spec, info }: { spec: Loop; info: Component }) {
  const [edits, set_edits] = useState<Record<string, string>>({});
  const changed = info.parameters.flatMap((parameter) => {
    const now = spec.spec.parameters[parameter.name] ?? parameter.default;
    const next = number(edits[parameter.name] ?? "");
    return next !== null && next !== now ? [[parameter.name, next, now] as const] : [];
  });
  const wrong = info.parameters.some((parameter) => {
    const next = number(edits[parameter.name] ?? "");
    return next !== null && (next < parameter.minimum || next > parameter.maximum);
  });
  return (
    <section class="panel" aria-label="Tuning">
      <h2>Tuning</h2>
      <table class="tuning">
        <thead>
          <tr>
            <th>Parameter</th>
            <th>Now</th>
            <th>New</th>
          </tr>
        </thead>
        <tbody>
          {info.parameters.map((parameter) => {
            const now = spec.spec.parameters[parameter.name] ?? parameter.default;
            const is_default = spec.spec.parameters[parameter.name] === undefined;
            return (
              <tr key={parameter.name} title={`${parameter.text} (${parameter.minimum} to ${parameter.maximum})`}>
                <th scope="row">
                  {parameter.name} <small>{parameter.unit}</small>
                </th>
                <td class={is_default ? "quiet" : ""}>{parameter.choices[now] ?? now}</td>
                <td>
                  {parameter.choices.length > 0 ? (
                    <select aria-label={`New ${parameter.name}`} value={edits[parameter.name] ?? ""} onChange={(event) => set_edits({ ...edits, [parameter.name]: event.currentTarget.value })}>
                      <option value="">keep</option>
                      {parameter.choices.map((choice, n) => (
                        <option key={choice} value={String(n)}>
                          {choice}
                        </option>
                      ))}
                    </select>
                  ) : (
                    <input inputMode="decimal" aria-label={`New ${parameter.name}`} value={edits[parameter.name] ?? ""} placeholder={String(now)} onInput={(event) => set_edits({ ...edits, [parameter.name]: event.currentTarget.value })} />
                  )}
                </td>
              </tr>
            );
          })}
        </tbody>
      </table>
      <Act
        off={changed.length === 0 || wrong}
        act={async () => {
          const next = Object.fromEntries(changed.map(([name, x]) => [name, x]));
          const before = Object.fromEntries(changed.map(([name, , now]) => [name, now]));
          const end = await send<Apply>("POST", path(spec.name, "/set"), { parameters: next });
          set_edits({});
          await load_specs();
          say(`${spec.name}: ${changed.map(([name, x]) => `${name} = ${x}`).join(", ")}${end.hand_over ? `, bump ${value(end.hand_over.bump_percent, 1)} %` : ""}`, async () => {
            await send("POST", path(spec.name, "/set"), { parameters: before });
            await load_specs();
          });
        }}
      >
        {wrong ? "Outside of what is allowed" : changed.length === 0 ? "Nothing changed" : `Put ${changed.length} in force`}
      </Act>
    </section>
  );
}

/** What outputs may do, whatever the controller says. */
function Limits({ spec, ports }: { spec: Loop; ports: string[] }) {
  const [draft, set_draft] = useState<Record<string, Record<string, string>>>({});
  const keys = ["low", "high", "rate_per_s", "safe"] as const;
  const dirty = Object.values(draft).some((row) => Object.keys(row).length > 0);
  return (
    <details class="panel">
      <summary>
        <h2>Output limits</h2>
      </summary>
      {ports.map((port) => {
        const out = actuate(spec, port);
        const limit = spec.spec.limits[port];
        const now: Record<string, number | null> = { low: limit?.low ?? out.low, high: limit?.high ?? out.high, rate_per_s: limit?.rate_per_s ?? null, safe: limit?.safe ?? out.low };
        return (
          <fieldset key={port}>
            <legend>
              {port} {out.unit && `(${out.unit})`}
            </legend>
            <div class="grid4">
              {keys.map((name) => (
                <label key={name} class="field">
                  <span>{{ low: "Low", high: "High", rate_per_s: "Rate per s", safe: "Safe" }[name]}</span>
                  <input inputMode="decimal" value={draft[port]?.[name] ?? String(now[name] ?? "")} placeholder="none" onInput={(event) => set_draft({ ...draft, [port]: { ...draft[port], [name]: event.currentTarget.value } })} />
                </label>
              ))}
            </div>
          </fieldset>
        );
      })}
      <Act
        off={!dirty}
        act={async () => {
          const limits = { ...spec.spec.limits };
          for (const [port, row] of Object.entries(draft)) {
            const out = actuate(spec, port);
            const base = limits[port] ?? { low: out.low, high: out.high, safe: out.low };
            const of = (name: string, old: number): number => (row[name] === undefined ? old : (number(row[name] ?? "") ?? Number.NaN));
            limits[port] = {
              low: of("low", base.low),
              high: of("high", base.high),
              rate_per_s: row.rate_per_s === undefined ? (base.rate_per_s ?? null) : number(row.rate_per_s),
              safe: of("safe", base.safe),
            };
          }
          await put(spec.name, { ...spec.spec, limits });
        }}
      >
        Put in force
      </Act>
    </details>
  );
}

/** Brings a specification into force; can be taken back where there was one before. */
async function put(name: string, draft: LoopDraft, before = true): Promise<void> {
  const end = await send<Apply>("PUT", path(name), draft);
  await load_specs();
  const words = [`${name}: ${end.unchanged ? "nothing differs" : `revision ${end.revision} is in force`}`, ...end.warnings];
  say(
    words.join("; "),
    before && !end.unchanged
      ? async () => {
          await send("POST", path(name, "/rollback"), {});
          await load_specs();
        }
      : undefined,
  );
}

function Revisions({ spec }: { spec: Loop }) {
  return (
    <details class="panel">
      <summary>
        <h2>Revisions</h2>
      </summary>
      <p>
        In force: <b>{spec.revision}</b>
        {spec.pending_revision ? `; ${spec.pending_revision} is on its way` : ""}
      </p>
      <div class="row wrap">
        {spec.past_revisions.map((revision) => (
          <Act
            key={revision}
            class="small"
            act={async () => {
              const from = spec.revision;
              const end = await send<Apply>("POST", path(spec.name, "/rollback"), { revision });
              await load_specs();
              say(`${spec.name}: revision ${revision} is back, as ${end.revision}`, async () => {
                await send("POST", path(spec.name, "/rollback"), { revision: from });
                await load_specs();
              });
            }}
          >
            Back to {revision}
          </Act>
        ))}
      </div>
      <Danger
        label="Delete the loop"
        title={`Delete ${spec.name}?`}
        text="The loop ends and its outputs stay as they are. Its recorded cycles go with it. This cannot be taken back."
        name={spec.name}
        act={async () => {
          await remove(path(spec.name));
          location.hash = "#/";
          say(`${spec.name} has ended.`);
        }}
      />
    </details>
  );
}

/** The whole specification as text: everything that the forms do not have. */
function Text({ spec }: { spec: LoopDraft }) {
  const [text, set_text] = useState(() => JSON.stringify(spec, null, 2));
  return (
    <details class="panel">
      <summary>
        <h2>Specification</h2>
      </summary>
      <p class="hint">All of it comes into force with one cycle, or nothing does.</p>
      <textarea class="code" aria-label="Specification as JSON" rows={18} spellcheck={false} value={text} onInput={(event) => set_text(event.currentTarget.value)} />
      <Act act={() => put(spec.name, JSON.parse(text) as LoopDraft)}>Put in force</Act>
    </details>
  );
}

const NEW = (component: string): string =>
  JSON.stringify({ name: "new-loop", component, period_ms: 100, ports: { pv: "", out: "" }, parameters: {}, setpoint: 0, mode: "manual", strategy: "round-robin", replicas: 3 }, null, 2);

/** A loop that is not there yet. */
export function NewLoop() {
  const [text, set_text] = useState(NEW(""));
  useEffect(() => void load_points(), []);
  return (
    <>
      <div class="head">
        <a class="back" href="#/" aria-label="Back to all loops">
          ←
        </a>
        <h1>New loop</h1>
      </div>
      <section class="panel narrow">
        <p class="hint">
          A component of the library, and a point for each of its ports. Beginning in manual leaves the outputs as they are. Points:{" "}
          {[...points.value.keys()].slice(0, 40).join(", ")}
        </p>
        <textarea class="code" aria-label="Loop as JSON" rows={22} spellcheck={false} value={text} onInput={(event) => set_text(event.currentTarget.value)} />
        <Act
          act={async () => {
            const draft = JSON.parse(text) as LoopDraft;
            await put(draft.name, draft, false);
            location.hash = `#/loop/${draft.name}`;
          }}
        >
          Create
        </Act>
      </section>
    </>
  );
}

/** What happened to this loop. */
function Happened({ loop }: { loop: string }) {
  const own = notices.value.filter((notice) => notice.loop === loop).slice(-40).reverse();
  return (
    <section class="panel" aria-label={`Events of ${loop}`}>
      <h2>Events</h2>
      {own.length === 0 && <None what="Nothing to tell." />}
      {/* It scrolls, so the keyboard must reach it. */}
      <ol class="events" tabIndex={0}>
        {own.map((notice) => (
          <li key={notice.number} class={notice.weight}>
            <time title={zone(notice.at_unix_us / 1_000)}>{clock(notice.at_unix_us / 1_000)}</time>
            <span>{notice.text}</span>
            <small>{ago(notice.at_unix_us / 1_000)}</small>
          </li>
        ))}
      </ol>
    </section>
  );
}
