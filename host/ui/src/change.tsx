// Another algorithm for a running loop, as one guided way: what cannot harm comes first, and each step shows what the next needs.
//
//   choose or drop ─► trial ─► backtest ─► shadow ─► switch ─► probation ─► in service
//                        └ refused: stays outside       └ refused: the old one never left   └ a fault: back by itself
//
// What was found is kept per loop as long as the page is open, so one may look elsewhere meanwhile.
// Never: skips the answer of a step, or moves the plant before the switch.

import { signal, type Signal } from "@preact/signals";
import { useEffect, useRef } from "preact/hooks";
import uPlot from "uplot";
import { get, list, remove, send, upload, words } from "./api";
import { bytes, clock, decimals, duration_us, value } from "./format";
import { actuate, type Followed, load_specs, loops, measure, notices } from "./live";
import { colour, colours } from "./theme";
import type { Admission, Apply, Component, Shadow, Trial } from "./types";
import { Act, complain, None, say } from "./ui";

interface Course {
  candidate: Component | null;
  parameters: Record<string, string>;
  refusal: string;
  busy: string;
  backtest: Trial | null;
  window: string;
  shadow: Shadow | null;
  cycles: number;
  end: Apply | null;
  before: number;
}

const courses = new Map<string, Signal<Course>>();

function course(loop: string): Signal<Course> {
  let known = courses.get(loop);
  if (!known) {
    known = signal({ candidate: null, parameters: {}, refusal: "", busy: "", backtest: null, window: "2m", shadow: null, cycles: 100, end: null, before: 0 });
    courses.set(loop, known);
  }
  return known;
}

const library = signal<Component[]>([]);

/** Takes a file that was dropped or chosen: uploads it and shows its trial. */
export async function take_file(loop: string, file: File): Promise<void> {
  const state = course(loop);
  state.value = { ...state.value, candidate: null, refusal: "", backtest: null, shadow: null, end: null, parameters: {}, busy: `${file.name} is being tried on made-up frames…` };
  try {
    const candidate = await upload<Component>(file, { note: `uploaded for ${loop}` });
    state.value = { ...state.value, candidate };
  } catch (error) {
    state.value = { ...state.value, refusal: words(error) };
  } finally {
    state.value = { ...state.value, busy: "" };
  }
}

export function Change(props: { name: string }) {
  const loop = loops.value.get(props.name);
  useEffect(() => {
    list<Component>("/v1/components", "components").then((all) => (library.value = all), complain);
  }, [props.name]);
  if (!loop) return <None what={`There is no loop ${props.name} (any more).`} />;
  return <ChangeOf key={props.name} loop={loop} />;
}

function ChangeOf({ loop }: { loop: Followed }) {
  const state = course(loop.name);
  const now = state.value;
  const put = (part: Partial<Course>): void => {
    state.value = { ...state.value, ...part };
  };
  const spec = loop.spec.value;
  const row = loop.row.value;
  const input = useRef<HTMLInputElement>(null);
  const parameters = Object.fromEntries(
    Object.entries(now.parameters).flatMap(([name, text]) => (text.trim() !== "" && Number.isFinite(Number(text)) ? [[name, Number(text)]] : [])),
  );
  const base = `/v1/loops/${encodeURIComponent(loop.name)}`;
  const step = now.end ? 5 : now.shadow?.complete ? 4 : now.backtest ? 3 : now.candidate ? 2 : 1;
  const on_probation = row?.probation_cycles_left ?? null;
  const went_back = now.end && spec && row && row.revision !== now.end.revision && row.revision !== now.before;
  const back = notices.value.findLast((notice) => notice.loop === loop.name && notice.kind === "rolled-back" && now.end && notice.text.includes(`revision ${now.end.revision} `));

  // A shadow is looked at as long as it follows.
  useEffect(() => {
    const id = now.shadow && !now.shadow.ended && !now.shadow.complete ? now.shadow.id : null;
    if (id === null) return;
    const every = setInterval(() => {
      get<Shadow>(`${base}/shadows/${id}`).then((shadow) => put({ shadow }), complain);
    }, 1_000);
    return () => clearInterval(every);
  }, [now.shadow?.id, now.shadow?.ended, now.shadow?.complete]);

  return (
    <>
      <div class="head">
        <a class="back" href={`#/loop/${loop.name}`} aria-label={`Back to ${loop.name}`}>
          ←
        </a>
        <h1>Change {loop.name}</h1>
        <p class="quiet">
          now {spec?.component}, revision {row?.revision}
        </p>
      </div>
      <ol class="course" aria-label="Steps">
        {["Component", "Backtest", "Shadow", "Switch", "Probation"].map((name, n) => (
          <li key={name} class={step > n + 1 ? "done" : step === n + 1 ? "now" : ""} aria-current={step === n + 1 ? "step" : undefined}>
            {name}
          </li>
        ))}
      </ol>

      <section class="panel stage" aria-label="Component and trial">
        <h2>1 · Component</h2>
        <p class="hint">Uploading changes nothing: the component is tried on made-up frames and stays outside if it traps, spins, writes no number or remembers between calls.</p>
        <div class="drop">
          <p>Drop a .wasm component here, or</p>
          <div class="row wrap">
            <input ref={input} type="file" accept=".wasm,application/wasm" class="hidden" tabIndex={-1} aria-label="Component file" onChange={(event) => {
              const file = event.currentTarget.files?.[0];
              if (file) void take_file(loop.name, file);
              event.currentTarget.value = "";
            }} />
            <button type="button" onClick={() => input.current?.click()}>
              Choose a file…
            </button>
            <label class="field inline">
              <span>or from the library</span>
              <select value={now.candidate?.digest ?? ""} onChange={(event) => {
                const found = library.value.find((one) => one.digest === event.currentTarget.value) ?? null;
                put({ candidate: found, refusal: "", backtest: null, shadow: null, end: null, parameters: {} });
              }}>
                <option value="">choose</option>
                {library.value.map((one) => (
                  <option key={one.digest} value={one.digest}>
                    {one.name}@{one.version} {one.digest === spec?.digest ? "(in force)" : ""}
                  </option>
                ))}
                {now.candidate && !library.value.some((one) => one.digest === now.candidate?.digest) && (
                  <option value={now.candidate.digest}>
                    {now.candidate.name}@{now.candidate.version}
                  </option>
                )}
              </select>
            </label>
          </div>
        </div>
        {now.busy && (
          <p role="status" class="busy">
            {now.busy}
          </p>
        )}
        {now.refusal && (
          <p role="alert" class="refusal">
            Not taken in: {now.refusal}
          </p>
        )}
        {now.candidate && (
          <>
            <p>
              <b>
                {now.candidate.name}@{now.candidate.version}
              </b>{" "}
              — {now.candidate.text} ({bytes(now.candidate.size_bytes)})
            </p>
            <AdmissionReport admission={now.candidate.admission} />
            <details>
              <summary>Parameters that differ from those that come over</summary>
              <div class="grid4">
                {now.candidate.parameters.map((parameter) => (
                  <label key={parameter.name} class="field">
                    <span title={parameter.text}>
                      {parameter.name} <small>{parameter.unit}</small>
                    </span>
                    <input inputMode="decimal" placeholder={String(spec?.spec.parameters[parameter.name] ?? parameter.default)} value={now.parameters[parameter.name] ?? ""} onInput={(event) => put({ parameters: { ...now.parameters, [parameter.name]: event.currentTarget.value }, backtest: null, shadow: null })} />
                  </label>
                ))}
              </div>
            </details>
          </>
        )}
      </section>

      <section class="panel stage" aria-label="Backtest" aria-disabled={!now.candidate}>
        <h2>2 · Backtest</h2>
        <p class="hint">On recorded cycles: what it would have sent. It cannot show where that would have led.</p>
        <div class="row wrap">
          <label class="field inline">
            <span>the last</span>
            <select value={now.window} onChange={(event) => put({ window: event.currentTarget.value })}>
              {["30s", "2m", "10m", "1h"].map((text) => (
                <option key={text}>{text}</option>
              ))}
            </select>
          </label>
          <Act off={!now.candidate} act={async () => put({ backtest: await send<Trial>("POST", `${base}/backtest`, { component: now.candidate?.digest, parameters, last: now.window }) })}>
            Backtest
          </Act>
        </div>
        {now.backtest && <TrialReport trial={now.backtest} loop={loop} />}
      </section>

      <section class="panel stage" aria-label="Shadow" aria-disabled={!now.candidate}>
        <h2>3 · Shadow</h2>
        <p class="hint">Beside the running loop, cycle by cycle; what it sends goes nowhere.</p>
        <div class="row wrap">
          <label class="field inline">
            <span>for cycles</span>
            <input class="short" inputMode="numeric" value={String(now.cycles)} onInput={(event) => put({ cycles: Math.max(1, Math.min(1_000_000, Number(event.currentTarget.value) || 1)) })} />
          </label>
          <Act off={!now.candidate || (now.shadow !== null && !now.shadow.ended && !now.shadow.complete)} act={async () => put({ shadow: await send<Shadow>("POST", `${base}/shadows`, { component: now.candidate?.digest, parameters, cycles: now.cycles }) })}>
            Start shadow
          </Act>
          {now.shadow && !now.shadow.ended && !now.shadow.complete && (
            <Act act={async () => put({ shadow: await remove<Shadow>(`${base}/shadows/${now.shadow?.id}`) })}>Stop</Act>
          )}
        </div>
        {now.shadow && (
          <>
            <progress max={now.shadow.cycles_wanted} value={now.shadow.report.cycles} aria-label="Cycles seen by the shadow" />
            <p>
              {now.shadow.report.cycles} of {now.shadow.cycles_wanted} cycles{now.shadow.missed ? `, ${now.shadow.missed} missed` : ""}
              {now.shadow.ended ? ` — ${now.shadow.ended}` : ""}
            </p>
            <TrialReport trial={now.shadow.report} loop={loop} />
          </>
        )}
      </section>

      <section class="panel stage" aria-label="Switch" aria-disabled={!now.candidate}>
        <h2>4 · Switch</h2>
        <p class="hint">
          Between two cycles both step on the same frame. If the output would step by more than {spec?.spec.policy.bump_limit_percent} % of its span, the old one keeps the cycle.
        </p>
        {now.candidate && !now.backtest && !now.shadow && <p class="warn-text">Neither backtest nor shadow was made; both are harmless.</p>}
        <Act
          class="primary"
          off={!now.candidate || now.candidate.digest === spec?.digest}
          act={async () => {
            if (!now.candidate || !spec) return;
            const before = row?.revision ?? spec.revision;
            const end =
              Object.keys(parameters).length === 0
                ? await send<Apply>("POST", `${base}/swap`, { component: now.candidate.digest })
                : await send<Apply>("PUT", base, {
                    ...spec.spec,
                    component: now.candidate.digest,
                    parameters: {
                      ...Object.fromEntries(Object.entries(spec.spec.parameters).filter(([name]) => now.candidate?.parameters.some((one) => one.name === name))),
                      ...parameters,
                    },
                  });
            put({ end, before });
            await load_specs();
            say(`${loop.name}: ${now.candidate.name}@${now.candidate.version} is in force`, async () => {
              await send("POST", `${base}/rollback`, { revision: before });
              await load_specs();
            });
          }}
        >
          Switch to {now.candidate ? `${now.candidate.name}@${now.candidate.version}` : "it"}
        </Act>
        {now.end && (
          <dl class="result">
            <dt>Revision</dt>
            <dd>{now.end.revision}</dd>
            {now.end.hand_over && (
              <>
                <dt>State came over by</dt>
                <dd>{now.end.hand_over.by}</dd>
                <dt>Bump</dt>
                <dd>{value(now.end.hand_over.bump_percent, 1)} % of span</dd>
              </>
            )}
            {now.end.dropped_parameters.length + now.end.dropped_ports.length > 0 && (
              <>
                <dt>Did not come over</dt>
                <dd>{[...now.end.dropped_parameters, ...now.end.dropped_ports].join("; ")}</dd>
              </>
            )}
            {now.end.warnings.map((text) => (
              <dd key={text} class="warn-text">
                {text}
              </dd>
            ))}
          </dl>
        )}
      </section>

      <section class="panel stage" aria-label="Probation">
        <h2>5 · Probation</h2>
        {!now.end && <p class="hint">For {spec?.spec.policy.probation_cycles} cycles the old one stays warm; a fault goes back in that same cycle.</p>}
        {now.end && back && (
          <p role="alert" class="refusal">
            Gone back: {back.text}
          </p>
        )}
        {now.end && !back && on_probation !== null && on_probation > 0 && (
          <>
            <progress max={spec?.spec.policy.probation_cycles ?? 1} value={(spec?.spec.policy.probation_cycles ?? 1) - on_probation} aria-label="Probation" />
            <p role="status">{on_probation} cycles left. The old one is warm.</p>
          </>
        )}
        {now.end && !back && !went_back && !on_probation && (
          <p role="status" class="good-text">
            In service.
          </p>
        )}
        {now.end && (
          <div class="row wrap">
            <Act
              act={async () => {
                const end = await send<Apply>("POST", `${base}/rollback`, { revision: now.before });
                await load_specs();
                put({ end: null });
                say(`${loop.name}: what ran before is back, as revision ${end.revision}`);
              }}
            >
              Go back to what ran before
            </Act>
            <a class="button" href={`#/loop/${loop.name}`}>
              To the faceplate
            </a>
          </div>
        )}
      </section>
    </>
  );
}

export function AdmissionReport({ admission }: { admission: Admission | null }) {
  if (!admission) return <p class="quiet">It had no trial.</p>;
  return (
    <div class="admission">
      <dl>
        <dt>Trial</dt>
        <dd>
          <b class={admission.findings.some((finding) => finding.severity === "refusal") ? "urgent-text" : ""}>{admission.verdict}</b> on {admission.host}, {admission.cycles} cycles
        </dd>
        <dt>Step</dt>
        <dd>
          half {duration_us(admission.step_p50_us)}, 99 % {duration_us(admission.step_p99_us)}, longest {duration_us(admission.step_worst_us)}
        </dd>
        <dt>Own state</dt>
        <dd>
          {admission.migrated}, {bytes(admission.state_bytes)}
        </dd>
        <dt>Memory</dt>
        <dd>{bytes(admission.memory_bytes)}</dd>
      </dl>
      <ul class="findings">
        {admission.findings.map((finding) => (
          <li key={finding.text} class={finding.severity}>
            {finding.text}
          </li>
        ))}
      </ul>
    </div>
  );
}

const VERDICTS = { same: "the same", close: "close: within what a switch may step", differs: "differs", fails: "fails" } as const;

function TrialReport({ trial, loop }: { trial: Trial; loop: Followed }) {
  return (
    <div class="trial">
      <p>
        Verdict: <b class={trial.verdict === "fails" ? "urgent-text" : trial.verdict === "differs" ? "warn-text" : ""}>{trial.verdict ? VERDICTS[trial.verdict] : "nothing to judge yet"}</b>
        {trial.reason ? ` — ${trial.reason}` : ""}
      </p>
      <dl>
        <dt>Compared</dt>
        <dd>
          {trial.compared} cycles, {trial.equal} equal to the last bit, {trial.faults} faults
        </dd>
        {trial.outputs.map((output) => (
          <>
            <dt key={`${output.port}-t`}>{output.port}</dt>
            <dd key={output.port}>
              at most {value(output.max_percent, 10)} %, on average {value(output.mean_percent, 10)} % of span apart
            </dd>
          </>
        ))}
        <dt>First bump</dt>
        <dd>
          {value(trial.bump_percent, 1)} % (allowed {trial.bump_limit_percent} %)
        </dd>
        <dt>Step</dt>
        <dd>
          half {duration_us(trial.steps.p50_us)}, longest {duration_us(trial.steps.worst_us)}
        </dd>
      </dl>
      {trial.first_fault && <p class="urgent-text">First fault, cycle {trial.first_fault.seq}: {trial.first_fault.text}</p>}
      {trial.dropped_parameters.length > 0 && <p class="warn-text">Left out: {trial.dropped_parameters.join("; ")}</p>}
      {trial.points.length > 1 && <Overlay trial={trial} loop={loop} />}
    </div>
  );
}

/** A scale with room below and above, in parts of what is drawn: so that outputs and measurement do not lie over each other. */
const apart =
  (below: number, above: number) =>
  (_: uPlot, low: number | null, high: number | null): [number, number] => {
    if (low === null || high === null) return [0, 1];
    const tall = Math.max(high - low, Math.abs(high) * 0.002, 1e-9);
    return [low - below * tall, high + above * tall];
  };

/** Both laws' outputs over each other, with setpoint and measurement. */
function Overlay({ trial, loop }: { trial: Trial; loop: Followed }) {
  const box = useRef<HTMLDivElement>(null);
  const port = trial.outputs[0]?.port ?? "";
  const [range, out] = [measure(loop.spec.value), actuate(loop.spec.value, port)];
  const paint = colours.value;
  useEffect(() => {
    const element = box.current;
    if (!element) return;
    const text = colour("muted");
    const font = "11px system-ui, sans-serif";
    const grid = { stroke: colour("line"), width: 1 };
    const series = (stroke: string, width: number, scale: string, dash?: number[]): uPlot.Series => ({ scale, stroke, width, dash, points: { show: false } });
    const u = new uPlot(
      {
        width: element.clientWidth,
        height: 240,
        legend: { show: false },
        cursor: { drag: { x: false, y: false } },
        axes: [
          { stroke: text, font, grid, space: 90, values: (_, splits) => splits.map((s) => clock(s * 1_000)) },
          { scale: "o", stroke: text, font, labelFont: font, grid, label: `${port} ${out.unit}`, labelSize: 16, size: 60, values: (_, splits) => splits.map((x) => x.toFixed(decimals(out.span))) },
          { scale: "y", side: 1, stroke: text, font, labelFont: font, label: range.unit, labelSize: 16, size: 56, grid: { show: false }, values: (_, splits) => splits.map((x) => x.toFixed(decimals(range.span))) },
        ],
        scales: { x: { time: true }, o: { range: apart(0.05, 0.45) }, y: { range: apart(0.9, 0.05) } },
        series: [{}, series(colour("setpoint"), 1, "y", [6, 4]), series(colour("pv"), 1, "y"), series(colour("out"), 2, "o"), series(colour("candidate"), 2, "o", [4, 3])],
      },
      [[], [], [], [], []],
      element,
    );
    u.setData([
      trial.points.map((point) => point.at_unix_us / 1e6),
      trial.points.map((point) => point.setpoint),
      trial.points.map((point) => point.measurement),
      trial.points.map((point) => point.recorded[0] ?? null),
      trial.points.map((point) => point.candidate[0] ?? null),
    ]);
    const resize = new ResizeObserver(() => u.setSize({ width: element.clientWidth, height: 240 }));
    resize.observe(element);
    return () => {
      resize.disconnect();
      u.destroy();
    };
  }, [trial, paint]);
  return (
    <figure>
      <div ref={box} role="img" aria-label={`Recorded and candidate output over ${trial.points.length} points; they are at most ${value(trial.outputs[0]?.max_percent, 10)} % of span apart.`} />
      <figcaption class="legend">
        <span class="key out">in force</span>
        <span class="key candidate">candidate</span>
        <span class="key pv">measurement</span>
        <span class="key sp">setpoint</span>
      </figcaption>
    </figure>
  );
}
