// Rollouts: one component for many loops, the first of them alone.

import { signal } from "@preact/signals";
import { useEffect, useState } from "preact/hooks";
import { get, list, send } from "./api";
import { value, when } from "./format";
import { loops } from "./live";
import type { Component, Rollout } from "./types";
import { Act, complain, None, say } from "./ui";

const all = signal<Rollout[]>([]);
const components = signal<Component[]>([]);

async function load(): Promise<void> {
  try {
    all.value = await list<Rollout>("/v1/rollouts", "rollouts");
  } catch (error) {
    complain(error);
  }
}

export function Rollouts(props: { id: string }) {
  useEffect(() => {
    void load();
    list<Component>("/v1/components", "components").then((found) => (components.value = found), complain);
    const every = setInterval(() => void load(), 2_000);
    return () => clearInterval(every);
  }, []);
  return (
    <>
      <div class="head">
        <h1>Rollouts</h1>
        <p class="quiet">one loop first, then the rest by rule</p>
      </div>
      <div class="split">
        <div>
          {all.value.map((rollout) => (
            <a key={rollout.id} class={`panel rollout ${rollout.state}`} href={`#/rollouts/${rollout.id}`}>
              <b>{rollout.component}</b> <span class={rollout.state === "failed" ? "tag urgent" : "tag"}>{rollout.state}</span>
              <progress max={rollout.total} value={rollout.done} aria-label={`Loops done in rollout ${rollout.id}`} />
              <small>
                {rollout.done} of {rollout.total} loops, began {when(rollout.started_at_unix_ms)} at {rollout.host}
              </small>
              {rollout.failure && <p class="urgent-text">{rollout.failure}</p>}
            </a>
          ))}
          {all.value.length === 0 && <None what="No rollouts yet." />}
          {props.id && <One key={props.id} id={props.id} />}
        </div>
        <Start />
      </div>
    </>
  );
}

function One({ id }: { id: string }) {
  const [one, set_one] = useState<Rollout | null>(null);
  useEffect(() => {
    const again = (): void => void get<Rollout>(`/v1/rollouts/${encodeURIComponent(id)}`).then(set_one, complain);
    again();
    const every = setInterval(again, 1_000);
    return () => clearInterval(every);
  }, [id]);
  if (!one) return null;
  return (
    <section class="panel" aria-label={`Rollout ${one.id}`}>
      <div class="row">
        <h2 class="grow">
          {one.component} — {one.id}
        </h2>
        {one.state === "running" && <Act act={() => send("POST", `/v1/rollouts/${encodeURIComponent(id)}/stop`, {})}>Stop</Act>}
      </div>
      <div class="scroll" tabIndex={0} role="region" aria-label="Table of rollouts">
        <table class="list">
          <thead>
            <tr>
              <th>Loop</th>
              <th>Stage</th>
              <th class="num">Cycles</th>
              <th class="num">Error before</th>
              <th class="num">Error since</th>
              <th>Why</th>
            </tr>
          </thead>
          <tbody>
            {one.loops.map((leg) => (
              <tr key={leg.loop}>
                <th scope="row">
                  <a href={`#/loop/${leg.loop}`}>{leg.loop}</a>
                </th>
                <td>{leg.stage}</td>
                <td class="num">
                  {leg.cycles} / {one.cycles}
                </td>
                <td class="num">{value(leg.error_before, 1)}</td>
                <td class="num">{value(leg.error, 1)}</td>
                <td>{leg.reason}</td>
              </tr>
            ))}
          </tbody>
        </table>
      </div>
    </section>
  );
}

function Start() {
  const [component, set_component] = useState("");
  const [chosen, set_chosen] = useState<string[]>([]);
  const [cycles, set_cycles] = useState("100");
  const [factor, set_factor] = useState("2");
  const [at_once, set_at_once] = useState("2");
  const [on_failure, set_on_failure] = useState("stop");
  const names = [...loops.value.keys()].sort((a, b) => a.localeCompare(b, undefined, { numeric: true }));
  return (
    <section class="panel" aria-label="New rollout">
      <h2>New rollout</h2>
      <label class="field">
        <span>Component</span>
        <select value={component} onChange={(event) => set_component(event.currentTarget.value)}>
          <option value="">choose</option>
          {components.value.map((one) => (
            <option key={one.digest} value={one.digest}>
              {one.name}@{one.version}
            </option>
          ))}
        </select>
      </label>
      <fieldset>
        <legend>Loops; the first that you choose goes first</legend>
        <div class="ticks">
          {names.map((name) => (
            <label key={name} class="check">
              <input type="checkbox" checked={chosen.includes(name)} onChange={(event) => set_chosen(event.currentTarget.checked ? [...chosen, name] : chosen.filter((one) => one !== name))} />
              {name} {chosen[0] === name && <small>(first)</small>}
            </label>
          ))}
        </div>
      </fieldset>
      <div class="grid4">
        <label class="field">
          <span>Cycles to watch</span>
          <input inputMode="numeric" value={cycles} onInput={(event) => set_cycles(event.currentTarget.value)} />
        </label>
        <label class="field">
          <span>Greatest error, × before</span>
          <input inputMode="decimal" value={factor} onInput={(event) => set_factor(event.currentTarget.value)} />
        </label>
        <label class="field">
          <span>At once</span>
          <input inputMode="numeric" value={at_once} onInput={(event) => set_at_once(event.currentTarget.value)} />
        </label>
        <label class="field">
          <span>On failure</span>
          <select value={on_failure} onChange={(event) => set_on_failure(event.currentTarget.value)}>
            <option value="stop">stop</option>
            <option value="back">all back</option>
          </select>
        </label>
      </div>
      <Act
        class="primary"
        off={!component || chosen.length === 0}
        act={async () => {
          const rollout = await send<Rollout>("POST", "/v1/rollouts", { component, loops: chosen, cycles: Number(cycles), factor: Number(factor), at_once: Number(at_once), on_failure });
          await load();
          say(`Rollout ${rollout.id} began with ${chosen[0]}.`);
          location.hash = `#/rollouts/${rollout.id}`;
        }}
      >
        Begin with {chosen[0] ?? "the first"}
      </Act>
    </section>
  );
}
