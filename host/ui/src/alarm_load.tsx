// How the alarm system does: the figures of ANSI/ISA-18.2 for the last day, the alarms that come most often, and those who are told.

import { useEffect, useState } from "preact/hooks";
import { told } from "./alarms";
import { get } from "./api";
import { day, when, zone } from "./format";
import { complain, None } from "./ui";

interface Figures {
  comings: number;
  now_per_10_min: number;
  mean_per_10_min: number;
  peak_per_10_min: number;
  floods: number;
  flood_percent: number;
  spans: number[];
  standing: number;
  unacknowledged: number;
  stale: number;
  quiet: number;
  percent_by_priority: [number, number, number];
  frequent: { loop: string; alarm: string; comings: number; percent: number; chattered: boolean }[];
  chattering: number;
  cut: boolean;
  silent: { host: string; reason: string }[];
}

interface Webhook {
  host: string;
  name: string;
  to: string;
  waiting: number;
  told: number;
  failed: number;
  refused: number;
  dropped: number;
  last_told_unix_ms: number | null;
  trouble: string | null;
}

/** Asked again so often, in ms: the figures are of spans of ten minutes. */
const ASK_MS = 30_000;
/** Comings in ten minutes that one person can still take. Source: ANSI/ISA-18.2, clause 16. */
const FLOOD = 10;
const SPAN_MS = 600_000;

export function Load({ open }: { open: (alarm: { loop: string; name: string }) => void }) {
  const [figures, set_figures] = useState<Figures | null>(null);
  const [hooks, set_hooks] = useState<Webhook[]>([]);
  // What came or went changes them at once.
  const stands_now = told.value.reduce((sum, alarm) => sum + alarm.comings, told.value.length);
  useEffect(() => {
    const ask = () => {
      get<Figures>("/v1/alarms/metrics").then(set_figures, complain);
      get<{ webhooks: Webhook[] }>("/v1/webhooks").then((list) => set_hooks(list.webhooks), complain);
    };
    ask();
    const timer = setInterval(ask, ASK_MS);
    return () => clearInterval(timer);
  }, [stands_now]);
  if (!figures) return <p class="quiet">Reading…</p>;
  const [low, medium, high] = figures.percent_by_priority.map((part) => `${part.toFixed(0)} %`);
  const rows: [string, string, string, boolean][] = [
    ["Comings in ten minutes, mean", figures.mean_per_10_min.toFixed(2), "up to 1, at most 2", figures.mean_per_10_min <= 2],
    ["– the ten minutes that run now", String(figures.now_per_10_min), `up to ${FLOOD}`, figures.now_per_10_min <= FLOOD],
    ["– the most", String(figures.peak_per_10_min), `up to ${FLOOD}`, figures.peak_per_10_min <= FLOOD],
    ["Time in flood (more than ten in ten minutes)", `${figures.flood_percent.toFixed(1)} %`, "below 1 %", figures.flood_percent < 1],
    ["Alarms that chattered (three times within a minute)", String(figures.chattering), "none", figures.chattering === 0],
    ["Alarms that stand for more than a day", String(figures.stale), "none", figures.stale === 0],
  ];
  return (
    <>
      {figures.silent.map((host) => (
        <p key={host.host} class="warn-text" role="status">
          {host.host} does not answer, so its alarms are not counted: {host.reason}
        </p>
      ))}
      {figures.cut && <p class="warn-text">There were more than could be looked at: these figures are too small.</p>}
      <p class="quiet">
        The last day of the whole cell: {figures.comings} comings (low {low}, medium {medium}, high {high}; about 80, 15 and 5 % are usual), {figures.standing} stand, {figures.unacknowledged} wait for an acknowledgement, {figures.quiet} are kept quiet and do not count.
      </p>
      <Spans spans={figures.spans} />
      <div class="scroll" tabIndex={0} role="region" aria-label="Table of figures">
        <table class="list stack">
          <thead>
            <tr>
              <th>Figure</th>
              <th class="num">Now</th>
              <th>By ANSI/ISA-18.2</th>
            </tr>
          </thead>
          <tbody>
            {rows.map(([what, found, wanted, good]) => (
              <tr key={what}>
                <th scope="row">{what}</th>
                <td class="num">{found}</td>
                <td>
                  {wanted} {!good && <span class="tag warn">exceeded</span>}
                </td>
              </tr>
            ))}
          </tbody>
        </table>
      </div>
      <h2>Came most often</h2>
      {figures.frequent.length === 0 && <None what="No alarm came in the last day." />}
      {figures.frequent.length > 0 && (
        <div class="scroll" tabIndex={0} role="region" aria-label="Table of frequent alarms">
          <table class="list stack">
            <thead>
              <tr>
                <th>Alarm</th>
                <th class="num">Comings</th>
                <th class="num">Of all</th>
                <th>Chattered</th>
              </tr>
            </thead>
            <tbody>
              {figures.frequent.map((one) => (
                <tr key={`${one.loop} ${one.alarm}`}>
                  <th scope="row">
                    <button type="button" class="link-button" onClick={() => open({ loop: one.loop, name: one.alarm })}>
                      {one.loop} <b>{one.alarm}</b>
                    </button>
                  </th>
                  <td class="num">{one.comings}</td>
                  <td class="num">{one.percent.toFixed(0)} %</td>
                  <td>{one.chattered ? "yes" : ""}</td>
                </tr>
              ))}
            </tbody>
          </table>
        </div>
      )}
      {hooks.length > 0 && <Hooks hooks={hooks} />}
    </>
  );
}

/** Comings in each ten minutes of the last day; what is above the line is a flood. */
function Spans({ spans }: { spans: number[] }) {
  const top = Math.max(FLOOD + 2, ...spans);
  const now = Date.now();
  const most = Math.max(...spans);
  return (
    <figure>
      <svg class="spans" viewBox={`0 0 ${spans.length} 40`} preserveAspectRatio="none" role="img" aria-label={`Comings in each ten minutes of the last day, at most ${most}`}>
        {spans.map((count, at) => (
          <rect key={at} class={count > FLOOD ? "flood" : ""} x={at + 0.1} width={0.8} y={40 - (40 * count) / top} height={(40 * count) / top}>
            <title>{`${count} in the ten minutes to ${when(now - (spans.length - 1 - at) * SPAN_MS)}`}</title>
          </rect>
        ))}
        <line x1={0} x2={spans.length} y1={40 - (40 * FLOOD) / top} y2={40 - (40 * FLOOD) / top} />
      </svg>
      <figcaption class="hint">Comings in each ten minutes, from yesterday to now ({zone()}); the line is at {FLOOD}, above it is a flood.</figcaption>
    </figure>
  );
}

function Hooks({ hooks }: { hooks: Webhook[] }) {
  return (
    <>
      <h2>Who is told</h2>
      <div class="scroll" tabIndex={0} role="region" aria-label="Table of webhooks">
        <table class="list stack">
          <thead>
            <tr>
              <th>Webhook</th>
              <th>Host</th>
              <th>To</th>
              <th class="num">Told</th>
              <th class="num">Wait</th>
              <th class="num">Lost</th>
              <th>Last told</th>
              <th>Trouble</th>
            </tr>
          </thead>
          <tbody>
            {hooks.map((hook) => (
              <tr key={`${hook.host} ${hook.name}`}>
                <th scope="row">{hook.name}</th>
                <td>{hook.host}</td>
                <td>{hook.to}</td>
                <td class="num">{hook.told}</td>
                <td class="num">{hook.waiting}</td>
                <td class="num">{hook.dropped + hook.refused}</td>
                <td>{hook.last_told_unix_ms === null ? "" : <time title={`${day(hook.last_told_unix_ms)} ${zone(hook.last_told_unix_ms)}`}>{when(hook.last_told_unix_ms)}</time>}</td>
                <td>{hook.trouble ?? ""}</td>
              </tr>
            ))}
          </tbody>
        </table>
      </div>
    </>
  );
}
