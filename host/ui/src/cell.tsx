// The cell: hosts with their load and who is how far from whom, events, and the faults of the demonstration.

import { signal } from "@preact/signals";
import { useState } from "preact/hooks";
import { send } from "./api";
import { bytes, clock, day, duration_us, zone } from "./format";
import { demo, hosts, loops, notices } from "./live";
import { told } from "./alarms";
import type { Host, Weight } from "./types";
import { Act, Bar, Danger, None, say } from "./ui";

/** Step times as owners saw them, by owner and by who stepped: the last ones, in µs. */
const seen = new Map<string, number[]>();
const SAMPLES = 200;
let counted = 0;

/** Notes the newest cycle of each loop. Called with each beat of the feed. */
export function note_steps(): void {
  counted += 1;
  for (const loop of loops.peek().values()) {
    const row = loop.row.peek();
    if (!row) continue;
    const key = `${row.owner} ${row.stepped_by}`;
    let list = seen.get(key);
    if (!list) seen.set(key, (list = []));
    list.push(row.step_us);
    if (list.length > SAMPLES) list.shift();
  }
}

function median(list: number[]): number {
  const sorted = [...list].sort((a, b) => a - b);
  return sorted[sorted.length >> 1] ?? 0;
}

const fault = (host: string, what: string, seconds = 5) => async (): Promise<void> => {
  await send("POST", "/v1/demo/faults", { host, fault: what, seconds });
  say(`${what} ${what === "stress" ? "the machine" : host}: asked for`);
};

/** Empties a host, or lets it take loops again. */
function Drain({ host }: { host: Host }) {
  const [keep, set_keep] = useState(false);
  const path = (what: string): string => `/v1/hosts/${encodeURIComponent(host.name)}/${what}`;
  if (host.draining) {
    return (
      <div class="row wrap">
        <Act
          class="small"
          label={`Take loops again, ${host.name}`}
          act={async () => {
            await send("POST", path("undrain"), {});
            say(`${host.name} takes loops again.`, () => send("POST", path("drain"), { keep: host.drain_kept }));
          }}
        >
          Take loops again
        </Act>
        <small>{host.loops_owned > 0 ? `${host.loops_owned} ${host.loops_owned === 1 ? "loop has" : "loops have"} nowhere else to go yet` : "empty: it may be switched off"}{host.drain_kept ? "; stays so over restarts" : ""}</small>
      </div>
    );
  }
  return (
    <div class="row wrap">
      <Act
        class="small"
        label={`Drain ${host.name}`}
        title="Its loops move to other hosts between two cycles; new ones stay away."
        act={async () => {
          const end = await send<{ loops_owned: number }>("POST", path("drain"), { keep });
          say(end.loops_owned === 0 ? `${host.name} is empty.` : `${host.name} still owns ${end.loops_owned} loops.`, () => send("POST", path("undrain"), {}));
        }}
      >
        Drain
      </Act>
      <label class="check">
        <input type="checkbox" checked={keep} aria-label={`${host.name} stays empty over restarts`} onChange={(event) => set_keep(event.currentTarget.checked)} /> over restarts too
      </label>
    </div>
  );
}

function HostCard({ host }: { host: Host }) {
  const roles = [host.io && "I/O", host.control && "control"].filter(Boolean).join(", ");
  const state = !host.alive ? "not alive" : host.draining ? "being emptied" : "alive";
  return (
    <article class={`panel host${host.alive ? "" : " grave"}`} aria-label={`Host ${host.name}`}>
      <header class="row">
        <h2 class="grow">
          {host.name} {host.here && <small>(serves this page)</small>}
        </h2>
        <span class={host.alive ? (host.draining ? "tag warn" : "tag") : "tag urgent"}>{state}</span>
      </header>
      <Bar label={`load of ${host.name}`} kind="pv" at={host.alive ? host.cpu_percent : null} low={0} high={100} unit="%" />
      <dl>
        <dt>Role</dt>
        <dd>{roles}</dd>
        <dt>Load</dt>
        <dd>
          {host.cpu_percent.toFixed(0)} % of its cores, {host.cpu_process_cores.toFixed(2)} cores itself
        </dd>
        <dt>Memory</dt>
        <dd>{bytes(host.memory_bytes)}</dd>
        <dt>Latency</dt>
        <dd>{host.latency_ms === null ? "–" : duration_us(host.latency_ms * 1_000)}</dd>
        <dt>Loops</dt>
        <dd>
          owns {host.loops_owned}, holds {host.loops_held}
        </dd>
        {host.labels?.length > 0 && (
          <>
            <dt>Labels</dt>
            <dd>{host.labels.join(", ")}</dd>
          </>
        )}
        <dt>Version</dt>
        <dd>{host.version}</dd>
      </dl>
      {host.api && !host.here && (
        <a class="small-link" href={`${host.api}/`}>
          open its page
        </a>
      )}
      {host.control && host.alive && <Drain host={host} />}
      {demo.value && (
        <div class="row wrap faults" role="group" aria-label={`Faults of ${host.name}`}>
          {host.alive ? (
            <>
              {host.io ? (
                <Danger label="Kill" title={`Kill ${host.name}?`} text="It serves the points: its loops stand still until it is back." name={host.name} act={fault(host.name, "kill")} />
              ) : (
                <Act class="small" label={`Kill ${host.name}`} act={fault(host.name, "kill")}>
                  Kill
                </Act>
              )}
              <Act class="small" label={`Pause 5 s, ${host.name}`} act={fault(host.name, "pause")}>
                Pause 5 s
              </Act>
              {!host.io && (
                <>
                  <Act class="small" label={`Delay 10 s, ${host.name}`} title="its way to the plant is 30 ms longer, each way" act={fault(host.name, "delay", 10)}>
                    Delay 10 s
                  </Act>
                  <Act class="small" label={`Lose 10 s, ${host.name}`} title="a tenth of what passes between it and the plant is lost and sent again" act={fault(host.name, "lose", 10)}>
                    Lose 10 s
                  </Act>
                </>
              )}
              <Act class="small" label={`Stress 5 s, the machine of ${host.name}`} act={fault(host.name, "stress")}>
                Stress 5 s
              </Act>
            </>
          ) : (
            <Act class="small" label={`Start again ${host.name}`} act={fault(host.name, "start")}>
              Start again
            </Act>
          )}
        </div>
      )}
    </article>
  );
}

export function Hosts() {
  counted;
  const all = hosts.value;
  const owners = all.filter((host) => all.some((other) => seen.has(`${host.name} ${other.name}`)));
  return (
    <>
      <div class="head">
        <h1>Hosts</h1>
        <p class="quiet">
          {all.filter((host) => host.alive).length} of {all.length} alive
        </p>
        {demo.value && <p class="tag">demonstration: faults are for you to make</p>}
      </div>
      <div class="cards hosts">
        {all.map((host) => (
          <HostCard key={host.name} host={host} />
        ))}
      </div>
      <section class="panel" aria-label="Latency of steps">
        <h2>Steps between hosts</h2>
        <p class="hint">Median time of a step as its owner saw it, network included, over the last {SAMPLES} cycles that this page saw of each pair.</p>
        {owners.length === 0 ? (
          <None what="No cycles seen yet." />
        ) : (
          <div class="scroll" tabIndex={0} role="region" aria-label="Table of steps between hosts">
            <table class="matrix">
              <thead>
                <tr>
                  <th scope="col">owner ↓ stepped by →</th>
                  {all.map((host) => (
                    <th key={host.name} scope="col">
                      {host.name}
                    </th>
                  ))}
                </tr>
              </thead>
              <tbody>
                {owners.map((owner) => (
                  <tr key={owner.name}>
                    <th scope="row">{owner.name}</th>
                    {all.map((by) => {
                      const list = seen.get(`${owner.name} ${by.name}`);
                      return <td key={by.name}>{list ? duration_us(median(list)) : "–"}</td>;
                    })}
                  </tr>
                ))}
              </tbody>
            </table>
          </div>
        )}
      </section>
    </>
  );
}

const least = signal<Weight>("info");
const event_filter = signal("");
const ORDER: Weight[] = ["info", "warning", "urgent"];

export function Events() {
  const wanted = event_filter.value.trim().toLowerCase();
  const shown = notices.value
    .filter((notice) => ORDER.indexOf(notice.weight) >= ORDER.indexOf(least.value) && `${notice.loop} ${notice.text}`.toLowerCase().includes(wanted))
    .slice(-300)
    .reverse();
  return (
    <>
      <div class="head">
        <h1>Events</h1>
        <p class="quiet">times in {zone()}</p>
        <div class="row end grow">
          <label class="field inline">
            <span>from</span>
            <select value={least.value} onChange={(event) => (least.value = event.currentTarget.value as Weight)}>
              {ORDER.map((weight) => (
                <option key={weight}>{weight}</option>
              ))}
            </select>
          </label>
          <input type="search" class="short" placeholder="filter" aria-label="Filter events" value={event_filter.value} onInput={(event) => (event_filter.value = event.currentTarget.value)} />
        </div>
      </div>
      {told.value.length > 0 && (
        <p class="above">
          {told.value.length} {told.value.length === 1 ? "alarm stands or waits" : "alarms stand or wait"} for a person: <a href="#/alarms">to the alarms</a>
        </p>
      )}
      <section class="panel" aria-label="All events">
        <ol class="events long">
          {shown.map((notice) => (
            <li key={notice.number} class={notice.weight}>
              <time title={day(notice.at_unix_us / 1_000)}>{clock(notice.at_unix_us / 1_000)}</time>
              <a href={`#/loop/${notice.loop}`}>{notice.loop}</a>
              <span>
                <b class="weight">{notice.weight === "info" ? "" : `${notice.weight}: `}</b>
                {notice.text}
              </span>
              <small>cycle {notice.seq}</small>
            </li>
          ))}
        </ol>
        {shown.length === 0 && <None what="Nothing to tell." />}
      </section>
    </>
  );
}
