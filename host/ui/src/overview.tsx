// All loops at a glance: what a wall shows. Colour only where something is not as it should be.

import { signal } from "@preact/signals";
import { memo } from "preact/compat";
import { useEffect, useRef } from "preact/hooks";
import { span_s, value } from "./format";
import { actuate, backfill, type Followed, forced_ports, hosts, is_old, link, loops, measure, tick } from "./live";
import { is_unseen, key_of, limits_of, says, told_of } from "./alarms";
import { Prio } from "./alarm_parts";
import { colour, colours } from "./theme";
import { Bar, None } from "./ui";

const filter = signal("");
const only_abnormal = signal(false);

/** What is not as it should be with a loop; the gravest first, none where all is well. */
export function abnormal(loop: Followed): { text: string; grave: boolean }[] {
  const found: { text: string; grave: boolean }[] = [];
  const [row, standing, spec] = [loop.row.value, loop.standing.value, loop.spec.value];
  tick.value;
  if (link.value === "live" && is_old(loop)) {
    const s = (performance.now() - loop.seen) / 1_000;
    found.push({ text: loop.seen ? `no cycle for ${span_s(s)}` : "no cycle yet", grave: true });
  }
  if (row) {
    if (row.quality === "bad") found.push({ text: "measurement is bad", grave: true });
    else if (row.quality === "uncertain") found.push({ text: "measurement is uncertain", grave: false });
    if (row.faults_in_row > 0) found.push({ text: `${row.faults_in_row} faulty cycles in a row`, grave: true });
  }
  // A fault and a bad measurement are said above, as long as they last.
  for (const alarm of told_of(loop.name)) {
    if (!(row && ["fault", "bad-quality", "redundancy-lost"].includes(alarm.definition.kind))) {
      found.push({ text: says(alarm, true), grave: alarm.priority === "high" && alarm.state !== "latched" });
    }
  }
  const held = forced_ports(spec);
  if (held.length > 0) found.push({ text: `${held.map(({ port }) => port).join(", ")} forced by hand`, grave: false });
  if (standing && spec && standing.members.length < Math.min(spec.spec.replicas, controllers())) {
    found.push({ text: `${standing.members.length} of ${spec.spec.replicas} replicas`, grave: standing.members.length === 0 });
  }
  if (standing && standing.failures > 0) found.push({ text: "a change is held up", grave: false });
  return found;
}

/** Hosts that may hold a loop, dead ones too: one that is missing is worth a word. */
function controllers(): number {
  return hosts.value.filter((host) => host.control).length;
}

/** The deviation of the last minute, in % of range, drawn a few times a second. */
const Spark = memo(function Spark(props: { loop: Followed }) {
  const canvas = useRef<HTMLCanvasElement>(null);
  useEffect(() => {
    const element = canvas.current;
    const context = element?.getContext("2d");
    if (!element || !context) return;
    let visible = true;
    const seen = new IntersectionObserver(([entry]) => (visible = entry?.isIntersecting ?? true));
    seen.observe(element);
    const draw = (): void => {
      if (!visible || document.hidden) return;
      backfill(props.loop);
      const dpr = devicePixelRatio;
      const [wide, tall] = [element.clientWidth * dpr, element.clientHeight * dpr];
      if (element.width !== wide || element.height !== tall) {
        element.width = wide;
        element.height = tall;
      }
      const { spark, spark_at } = props.loop;
      context.clearRect(0, 0, wide, tall);
      context.fillStyle = colour("line");
      context.fillRect(0, tall / 2, wide, dpr);
      let top = 1;
      for (const x of spark) if (Math.abs(x) > top) top = Math.abs(x);
      context.strokeStyle = colour("pv");
      context.lineWidth = 1.25 * dpr;
      context.beginPath();
      let pen = false;
      for (let i = 0; i < spark.length; i++) {
        const y = spark[(spark_at + i) % spark.length] as number;
        if (Number.isNaN(y)) {
          pen = false;
          continue;
        }
        const [px, py] = [(i / (spark.length - 1)) * wide, tall / 2 - (y / top) * (tall / 2 - dpr)];
        if (pen) context.lineTo(px, py);
        else context.moveTo(px, py);
        pen = true;
      }
      context.stroke();
    };
    draw();
    const every = setInterval(draw, 500);
    const again = colours.subscribe(() => draw());
    return () => {
      clearInterval(every);
      seen.disconnect();
      again();
    };
  }, [props.loop]);
  return <canvas ref={canvas} class="spark" aria-hidden="true" />;
});

const Card = memo(function Card(props: { loop: Followed }) {
  const { loop } = props;
  const [row, spec, standing] = [loop.row.value, loop.spec.value, loop.standing.value];
  const range = measure(spec);
  const found = abnormal(loop);
  const grave = found.some((one) => one.grave);
  const own = told_of(loop.name);
  const port = row ? (Object.keys(row.outputs)[0] ?? "") : "";
  const out = actuate(spec, port);
  if (only_abnormal.value && found.length === 0) return null;
  return (
    <article class={`card${grave ? " grave" : found.length ? " odd" : ""}${is_old(loop) ? " old" : ""}`} aria-label={loop.name}>
      <header>
        <a href={`#/loop/${loop.name}`}>{loop.name}</a>
        {own.slice(0, 3).map((alarm) => (
          <Prio key={key_of(alarm)} priority={alarm.priority} seen={!is_unseen(alarm)} label={`${alarm.priority} alarm ${alarm.name}`} />
        ))}
        {forced_ports(spec).length > 0 && <span class="tag forced">FORCED</span>}
        {row?.mode === "manual" && <span class="tag manual">MAN</span>}
        {row?.probation_cycles_left ? <span class="tag">probation {row.probation_cycles_left}</span> : null}
        {standing?.pending_revision ? <span class="tag">changing</span> : null}
      </header>
      <div class="numbers">
        <span class="big">
          {value(row?.measurement, range.span)} <small>{range.unit}</small>
        </span>
        <span class="sub">
          SP {value(row?.setpoint, range.span)}
          <br />
          OUT {value(port ? row?.outputs[port] : null, out.span)} {out.unit}
        </span>
      </div>
      <Bar label={`measurement of ${loop.name}`} kind="pv" at={row?.measurement ?? null} mark={row?.setpoint} low={range.low} high={range.high} unit={range.unit} limits={limits_of(loop.name)} />
      <Bar label={`output of ${loop.name}`} kind="out" at={port ? (row?.outputs[port] ?? null) : null} low={out.low} high={out.high} unit={out.unit} limits={port ? limits_of(loop.name, port) : undefined} />
      <Spark loop={loop} />
      <footer>
        <span class="trouble">{found[0]?.text ?? ""}</span>
        <span class="who" title="owner, and hosts that hold the loop">
          {row?.owner ?? "–"}
          <span class="dots" role="img" aria-label={`${standing?.members.length ?? 0} replicas on line`}>
            {Array.from({ length: spec?.spec.replicas ?? 0 }, (_, n) => (
              <i key={n} class={n < (standing?.members.length ?? 0) ? "on" : ""} />
            ))}
          </span>
        </span>
      </footer>
    </article>
  );
});

export function Overview() {
  const all = [...loops.value.values()].sort((a, b) => a.name.localeCompare(b.name, undefined, { numeric: true }));
  const shown = all.filter((loop) => loop.name.includes(filter.value.trim().toLowerCase()));
  const odd = all.filter((loop) => abnormal(loop).length > 0).length;
  return (
    <>
      <div class="head">
        <h1>Loops</h1>
        <p class="quiet">
          {all.length} {all.length === 1 ? "loop" : "loops"}, {odd === 0 ? "all as they should be" : `${odd} not as it should be`}
        </p>
        <div class="row end grow">
          <label class="check">
            <input type="checkbox" checked={only_abnormal.value} onChange={(event) => (only_abnormal.value = event.currentTarget.checked)} /> only what is abnormal
          </label>
          <input type="search" class="short" placeholder="filter by name" aria-label="Filter loops by name" value={filter.value} onInput={(event) => (filter.value = event.currentTarget.value)} />
          <a class="button" href="#/new">
            New loop
          </a>
        </div>
      </div>
      {all.length === 0 && link.value === "live" && <None what="No loops yet. Upload a component, then make a loop of it." />}
      <div class={`cards${all.length > 24 ? " many" : all.length < 9 ? " few" : ""}`}>
        {shown.map((loop) => (
          <Card key={loop.name} loop={loop} />
        ))}
      </div>
    </>
  );
}
