// The trend of one loop: setpoint, measurement and outputs over time, with the replicas' lane and the times of the steps below.
// It follows what comes, pans back into the log and from there into the history without a seam, and comes back to now.
//
// Keys: ← → pan, with Shift from cycle to cycle, + − zoom, End now. Never: more redraws than the screen has frames.

import { useSignalEffect } from "@preact/signals";
import { useEffect, useMemo, useRef, useState } from "preact/hooks";
import uPlot from "uplot";
import "uplot/dist/uPlot.min.css";
import { type Columns, Past } from "./columns";
import { clock, day, decimals, duration_us, span_s, value, zone } from "./format";
import { follow, hosts, link, loops, notices, trace, trace_grew } from "./live";
import type { Limit } from "./alarms";
import { draw_limits, with_limits } from "./limits";
import { colour, colours, host_colour } from "./theme";

const SPANS_S = [30, 60, 300, 900, 3_600, 14_400, 86_400, 604_800];
/** The longest window: a year. */
const SPAN_MAX_S = 31_622_400;

interface View {
  span: number;
  /** End in s; null for now. */
  end: number | null;
}

interface Axis {
  unit: string;
  low: number;
  high: number;
}

export function TrendView(props: { loop: string; ports: string[]; replicas: number; period_ms: number; measure: Axis; actuate: Axis; limits: Limit[] }) {
  const limits = useRef(props.limits);
  limits.current = props.limits;
  const box = useRef<HTMLDivElement>(null);
  const lanes = useRef<HTMLCanvasElement>(null);
  const [span, set_span] = useState(300);
  const [now, set_now] = useState(true);
  const [at, set_at] = useState<number | null>(null);
  const [failure, set_failure] = useState("");
  const [, set_drawn] = useState(0);
  const shown = useRef<Columns | null>(null);
  const [share, set_share] = useState<[string, number][]>([]);
  const view = useRef<View>({ span: 300, end: null });
  const plot = useRef<uPlot | null>(null);
  const frame = useRef(0);
  const past = useMemo(() => new Past(props.loop, () => draw()), [props.loop]);

  const newest = (): number => {
    const row = trace.rows.at(-1) ?? loops.peek().get(props.loop)?.row.peek();
    return row ? row.at_unix_us / 1e6 : Date.now() / 1_000;
  };
  const window_of = (): [number, number] => {
    const end = view.current.end ?? newest();
    return [end - view.current.span, end];
  };

  const draw = (): void => {
    if (frame.current) return;
    frame.current = requestAnimationFrame(() => {
      frame.current = 0;
      const u = plot.current;
      if (!u) return;
      const [min, max] = window_of();
      const live_from = trace.rows[0] ? trace.rows[0].at_unix_us / 1e6 : newest();
      past.cover(min, max, u.bbox.width / devicePixelRatio, live_from);
      const columns = past.columns(trace, props.ports, min, max);
      shown.current = columns;
      const bands = [columns.measurement_max, columns.measurement_min, ...props.ports.flatMap((_, n) => [columns.outputs_max[n], columns.outputs_min[n]])];
      u.setData([columns.x, columns.setpoint, columns.measurement, ...columns.outputs, ...bands] as uPlot.AlignedData, false);
      u.setScale("x", { min, max });
      draw_lanes();
      set_failure(past.failure);
      // What is said below the curves follows them.
      set_drawn((n) => n + 1);
    });
  };

  const move = (to: Partial<View>): void => {
    view.current = { ...view.current, ...to };
    const v = view.current;
    // Beyond now there is nothing: that is following.
    if (v.end !== null && v.end >= newest() - 0.5) v.end = null;
    set_span(v.span);
    set_now(v.end === null);
    draw();
  };
  const pan = (part: number): void => {
    const [, end] = window_of();
    move({ end: end + part * view.current.span });
  };
  const zoom = (factor: number): void => move({ span: Math.min(SPAN_MAX_S, Math.max(5, view.current.span * factor)) });

  /** The cursor by cycles, for keyboards; it stops the view, so that the cycle stays where it is. */
  const step_cursor = (by: number): void => {
    const [u, columns] = [plot.current, shown.current];
    if (!u || !columns || columns.x.length === 0) return;
    if (view.current.end === null) move({ end: window_of()[1] - 1 });
    const next = Math.min(columns.x.length - 1, Math.max(0, (u.cursor.idx ?? columns.x.length - 1) + by));
    u.setCursor({ left: u.valToPos(columns.x[next] as number, "x"), top: 1 });
  };

  const draw_lanes = (): void => {
    const [u, canvas, columns] = [plot.current, lanes.current, shown.current];
    const context = canvas?.getContext("2d");
    if (!u || !canvas || !columns || !context) return;
    const dpr = devicePixelRatio;
    const [left, width] = [u.bbox.left, u.bbox.width];
    const height = canvas.clientHeight;
    if (canvas.width !== Math.round(canvas.clientWidth * dpr) || canvas.height !== Math.round(height * dpr)) {
      canvas.width = Math.round(canvas.clientWidth * dpr);
      canvas.height = Math.round(height * dpr);
    }
    const [min, max] = window_of();
    const names = hosts.peek().map((host) => host.name);
    const colour_of = new Map(names.map((name) => [name, host_colour(name, names)]));
    const [muted, warn, line, text] = [colour("muted"), colour("warn"), colour("line"), colour("data")];
    context.clearRect(0, 0, canvas.width, canvas.height);
    const x_of = (x: number): number => left + ((x - min) / (max - min)) * width;
    const unit = dpr;
    const rows = { by: 0, online: 22, write: 46, step: 84 } as const;
    const strip = 30 * unit;
    context.font = `${10 * unit}px system-ui, sans-serif`;
    const period = props.period_ms / 1_000;
    const top_write = Math.max(1_000, ...columns.write_us);
    const top_step = Math.max(100, ...columns.step_us);
    context.save();
    context.beginPath();
    context.rect(left, 0, width, canvas.height);
    context.clip();
    context.fillStyle = line;
    for (const y of [rows.online + 20, rows.write + 30, rows.step + 30]) context.fillRect(left, y * unit, width, unit);
    const counts = new Map<string, number>();
    for (let i = 0; i < columns.x.length; i++) {
      const x = columns.x[i] as number;
      const from = x_of(x);
      // A cycle lasts until the next one; where none is known, for its period.
      const gap = (columns.x[i + 1] ?? x + period) - x;
      const piece = (max - min) / (width / dpr);
      const to = x_of(x + Math.min(gap, Math.max(period * 1.5, piece * 4)));
      const wide = Math.max(unit * 0.8, to - from);
      const by = columns.by[i] as string;
      const step_only = columns.cycles[i] !== 1;
      // A piece of the history does not say who stepped.
      if (!step_only) {
        counts.set(by, (counts.get(by) ?? 0) + 1);
        context.fillStyle = colour_of.get(by) ?? muted;
        context.fillRect(from, rows.by * unit, wide - (wide > 4 * unit ? unit : 0), 16 * unit);
      }
      const online = columns.online[i];
      if (online !== null && online !== undefined) {
        const tall = 18 * unit * Math.min(1, online / Math.max(1, props.replicas));
        context.fillStyle = online < props.replicas ? warn : muted;
        context.fillRect(from, (rows.online + 20) * unit - tall, wide, tall);
      }
      const late = (columns.write_us[i] as number) > props.period_ms * 500;
      const write = strip * Math.min(1, (columns.write_us[i] as number) / top_write);
      context.fillStyle = late ? warn : text;
      context.fillRect(from, (rows.write + 30) * unit - write, Math.max(unit, Math.min(wide, 3 * unit)), write);
      const step = strip * Math.min(1, (columns.step_us[i] as number) / top_step);
      context.fillStyle = text;
      context.fillRect(from, (rows.step + 30) * unit - step, Math.max(unit, Math.min(wide, 3 * unit)), step);
    }
    const cursor = u.cursor.idx;
    if (cursor !== null && cursor !== undefined && columns.x[cursor] !== undefined) {
      context.fillStyle = colour("text");
      context.fillRect(x_of(columns.x[cursor] as number), 0, unit, canvas.height);
    }
    context.restore();
    context.fillStyle = muted;
    context.textAlign = "right";
    const label = (words: string, y: number): void => context.fillText(words, left - 6 * unit, y * unit);
    label("stepped by", 12);
    label("on line", rows.online + 14);
    label("write", rows.write + 12);
    label(duration_us(top_write), rows.write + 25);
    label("step", rows.step + 12);
    label(duration_us(top_step), rows.step + 25);
    const total = [...counts.values()].reduce((sum, n) => sum + n, 0) || 1;
    const shares = [...counts].map(([name, n]): [string, number] => [name, n / total]);
    shares.sort((a, b) => a[0].localeCompare(b[0]));
    set_share((old) => (JSON.stringify(old) === JSON.stringify(shares.map(([n, p]) => [n, Math.round(p * 100) / 100])) ? old : shares.map(([n, p]) => [n, Math.round(p * 100) / 100])));
  };

  // The plot lives as long as loop, ports and colours do.
  const [paint, set_paint] = useState(0);
  useSignalEffect(() => set_paint(colours.value));
  useEffect(() => {
    const element = box.current;
    if (!element) return;
    const measure_span = props.measure.high - props.measure.low;
    const actuate_span = props.actuate.high - props.actuate.low;
    const text = colour("muted");
    const grid = { stroke: colour("line"), width: 1 };
    const font = "11px system-ui, sans-serif";
    const axis = (unit: string, span: number): Partial<uPlot.Axis> => ({
      stroke: text,
      font,
      labelFont: font,
      grid,
      ticks: { ...grid, size: 4 },
      label: unit,
      labelSize: 16,
      values: (u, splits) => {
        const near = Math.abs((u.scales.y?.max ?? 1) - (u.scales.y?.min ?? 0));
        return splits.map((split) => split.toFixed(Math.max(0, decimals(span) - (near > span / 3 ? 1 : 0))));
      },
    });
    // Measurement in the upper part, outputs in the lower one, so that two quiet curves do not lie over each other.
    const padded =
      (least: number, below: number, above: number) =>
      (_: uPlot, low: number | null, high: number | null): [number, number] => {
        if (low === null || high === null) return [0, 1];
        const pad = Math.max((high - low) * 0.06, least / 2 - (high - low) / 2, least * 0.02);
        const tall = high - low + 2 * pad;
        return [low - pad - below * tall, high + pad + above * tall];
      };
    const narrow = element.clientWidth < 520;
    const options: uPlot.Options = {
      width: element.clientWidth,
      height: element.clientHeight,
      legend: { show: false },
      cursor: { drag: { x: false, y: false }, y: false, points: { size: 6 } },
      scales: {
        x: { time: true, auto: false },
        y: { range: (u, low, high) => padded(measure_span * 0.04, 0.62, 0)(u, ...with_limits(limits.current, measure_span * 0.04, low, high)) },
        o: { range: padded(actuate_span * 0.04, 0, 1.6) },
      },
      axes: [
        { stroke: text, font, grid, ticks: { ...grid, size: 4 }, space: 90, values: (_, splits) => splits.map((s) => clock(s * 1_000)) },
        { scale: "y", size: narrow ? 52 : 62, ...axis(narrow ? "" : props.measure.unit, measure_span) },
        { scale: "o", side: 1, size: narrow ? 44 : 56, ...axis(narrow ? "" : props.actuate.unit, actuate_span), grid: { show: false } },
      ],
      series: [
        {},
        { label: "setpoint", scale: "y", stroke: colour("setpoint"), width: 1.5, dash: [6, 4], points: { show: false }, paths: uPlot.paths.stepped?.({ align: 1 }) },
        { label: "measurement", scale: "y", stroke: colour("pv"), width: 2, points: { show: false } },
        ...props.ports.map((port) => ({
          label: port,
          scale: "o",
          stroke: colour("out"),
          width: 1.25,
          points: { show: false },
          paths: uPlot.paths.stepped?.({ align: 1 }),
        })),
        // Greatest and least of the history's pieces: no lines of their own, only what lies between them.
        ...["y", "y", ...props.ports.flatMap(() => ["o", "o"])].map((scale) => ({ scale, width: 0, stroke: "transparent", points: { show: false } })),
      ],
      bands: [0, ...props.ports.map((_, n) => n + 1)].map((n) => {
        const first = 3 + props.ports.length + 2 * n;
        return { series: [first, first + 1] as [number, number], fill: `color-mix(in srgb, ${colour(n === 0 ? "pv" : "out")} 25%, transparent)` };
      }),
      hooks: {
        setCursor: [
          (u) => {
            set_at(u.cursor.idx ?? null);
            draw_lanes();
          },
        ],
        draw: [
          (u) => {
            draw_limits(u, limits.current, measure_span);
            const context = u.ctx;
            const [min, max] = window_of();
            const dpr = devicePixelRatio;
            const own = notices.peek().filter((notice) => notice.loop === props.loop);
            const told = new Map([...past.notices, ...own].map((notice) => [`${notice.term}-${notice.seq}-${notice.kind}`, notice]));
            for (const notice of told.values()) {
              const x = notice.at_unix_us / 1e6;
              if (x < min || x > max || notice.kind === "limited") continue;
              const at = u.valToPos(x, "x", true);
              context.fillStyle = notice.weight === "urgent" ? colour("urgent") : notice.weight === "warning" ? colour("warn") : colour("muted");
              context.globalAlpha = notice.weight === "info" ? 0.5 : 1;
              context.fillRect(at, u.bbox.top, dpr, u.bbox.height);
              context.beginPath();
              context.moveTo(at - 4 * dpr, u.bbox.top);
              context.lineTo(at + 4 * dpr, u.bbox.top);
              context.lineTo(at, u.bbox.top + 7 * dpr);
              context.fill();
              context.globalAlpha = 1;
            }
            const columns = shown.current;
            if (!columns) return;
            context.fillStyle = colour("urgent");
            for (let i = 0; i < columns.x.length; i++) {
              if (columns.good[i]) continue;
              const from = u.valToPos(columns.x[i] as number, "x", true);
              context.fillRect(from, u.bbox.top + u.bbox.height - 4 * dpr, 2 * dpr, 4 * dpr);
            }
          },
        ],
      },
    };
    const u = new uPlot(options, [[], [], [], [], [], ...props.ports.flatMap(() => [[], [], []])] as uPlot.AlignedData, element);
    plot.current = u;
    const resize = new ResizeObserver(() => {
      u.setSize({ width: element.clientWidth, height: element.clientHeight });
      draw();
    });
    resize.observe(element);
    draw();
    return () => {
      resize.disconnect();
      cancelAnimationFrame(frame.current);
      frame.current = 0;
      u.destroy();
      plot.current = null;
    };
  }, [props.loop, props.ports.join(), props.measure.unit, props.measure.high, props.actuate.high, paint]);

  useEffect(() => {
    follow(props.loop);
    return () => {
      past.end();
      follow("");
    };
  }, [props.loop]);
  useSignalEffect(() => {
    if (trace_grew.value >= 0 && (view.current.end === null || past.failure)) draw();
  });
  useEffect(() => draw(), [JSON.stringify(props.limits)]);
  useSignalEffect(() => {
    if (link.value === "live") {
      past.forget();
      draw();
    }
  });

  const drag = useRef<{ x: number; end: number } | null>(null);
  const columns = shown.current;
  const i = columns ? (at ?? columns.x.length - 1) : -1;
  const x = columns?.x[i];
  const says =
    columns && x !== undefined
      ? {
          time: `${day(x * 1_000)} ${clock(x * 1_000)}.${String(Math.floor((x % 1) * 10))} ${zone(x * 1_000)}`,
          setpoint: value(columns.setpoint[i], props.measure.high - props.measure.low),
          measurement: value(columns.measurement[i], props.measure.high - props.measure.low),
        }
      : null;
  return (
    <section class="trend" aria-label={`Trend of ${props.loop}`}>
      <div class="trend-tools" role="toolbar" aria-label="Time window">
        <div class="segments">
          {SPANS_S.map((s) => (
            <button key={s} type="button" aria-pressed={span === s} onClick={() => move({ span: s })}>
              {span_s(s)}
            </button>
          ))}
        </div>
        <div class="segments">
          <button type="button" aria-label="Back by half a window" onClick={() => pan(-0.5)}>
            ◀
          </button>
          <button type="button" aria-label="Forward by half a window" disabled={now} onClick={() => pan(0.5)}>
            ▶
          </button>
          <button type="button" aria-label="Zoom in" onClick={() => zoom(0.5)}>
            +
          </button>
          <button type="button" aria-label="Zoom out" onClick={() => zoom(2)}>
            −
          </button>
          <button type="button" aria-pressed={now} onClick={() => move({ end: null })}>
            Now
          </button>
        </div>
        <div class="legend" aria-hidden="true">
          <span class="key pv">measurement</span>
          <span class="key sp">setpoint</span>
          <span class="key out">output</span>
        </div>
      </div>
      <div
        class="plot"
        ref={box}
        tabIndex={0}
        role="img"
        aria-label={`${says ? `At ${says.time}: setpoint ${says.setpoint}, measurement ${says.measurement} ${props.measure.unit}.` : "No data yet."} The last ${span_s(span)}${now ? "" : ", looking back"}. Left and right arrow keys pan, plus and minus zoom, End goes to now.`}
        onKeyDown={(event) => {
          const keys: Record<string, () => void> = {
            ArrowLeft: () => pan(-0.1),
            ArrowRight: () => pan(0.1),
            PageUp: () => pan(-1),
            PageDown: () => pan(1),
            "+": () => zoom(0.5),
            "-": () => zoom(2),
            End: () => move({ end: null }),
          };
          const act = event.shiftKey && event.key.startsWith("Arrow") ? () => step_cursor(event.key === "ArrowLeft" ? -1 : 1) : keys[event.key];
          if (act) {
            event.preventDefault();
            act();
          }
        }}
        onWheel={(event) => {
          if (!event.ctrlKey && !event.shiftKey && Math.abs(event.deltaX) <= Math.abs(event.deltaY)) return;
          event.preventDefault();
          if (event.ctrlKey) zoom(event.deltaY > 0 ? 1.2 : 1 / 1.2);
          else pan((event.deltaX || event.deltaY) / 1_000);
        }}
        onPointerDown={(event) => {
          drag.current = { x: event.clientX, end: window_of()[1] };
          event.currentTarget.setPointerCapture(event.pointerId);
        }}
        onPointerMove={(event) => {
          const from = drag.current;
          const wide = plot.current ? plot.current.bbox.width / devicePixelRatio : 1;
          if (from && Math.abs(event.clientX - from.x) > 3) {
            move({ end: from.end - ((event.clientX - from.x) / wide) * view.current.span });
          }
        }}
        onPointerUp={() => (drag.current = null)}
        onPointerCancel={() => (drag.current = null)}
      />
      <canvas class="lanes" ref={lanes} aria-hidden="true" />
      <div class="readout">
        {columns && says ? (
          <>
            <span>{says.time}</span>
            {columns.cycles[i] === 1 ? (
              <span>cycle {columns.seq[i]}</span>
            ) : (
              <span>
                mean of {columns.cycles[i]} cycles in {span_s(columns.long[i] ?? 0)}, PV {value(columns.measurement_min[i], props.measure.high - props.measure.low)} to{" "}
                {value(columns.measurement_max[i], props.measure.high - props.measure.low)}
              </span>
            )}
            <span>
              SP {says.setpoint} · PV {says.measurement} {props.measure.unit}
            </span>
            {props.ports.map((port, n) => (
              <span key={port}>
                {port} {value(columns.outputs[n]?.[i], props.actuate.high - props.actuate.low)} {props.actuate.unit}
              </span>
            ))}
            {columns.cycles[i] === 1 && (
              <span>
                owner {columns.owner[i]}, stepped by {columns.by[i]}
              </span>
            )}
            <span>
              step {duration_us(columns.step_us[i])}
              {columns.cycles[i] === 1 && `, written after ${duration_us(columns.write_us[i])}`}
            </span>
          </>
        ) : (
          <span>no cycles in this window</span>
        )}
      </div>
      <div class="shares" aria-label="Who stepped the cycles of this window">
        {share.map(([name, part]) => (
          <span key={name}>
            <i style={{ background: host_colour(name, hosts.value.map((host) => host.name)) }} /> {name} {(part * 100).toFixed(0)} %
          </span>
        ))}
        {failure && <span class="warn-text">{failure}</span>}
      </div>
    </section>
  );
}
