// What a loop does when hosts go away or err: replicas, votes, preferred hosts, the fallback, and what a fault leads to.
// All of it comes into force with one cycle; it can be taken back.

import { useEffect, useState } from "preact/hooks";
import { get, list } from "./api";
import { complain, Act } from "./ui";
import { number } from "./format";
import { hosts } from "./live";
import type { Component, Loop, LoopDraft, Vote } from "./types";

/** A loop asks for at most so many hosts, and prefers at most so many. */
const REPLICAS_MAX = 16;
const PREFERRED_MAX = 8;
const LOOK_MS = 2_000;

const ON_FAULT: [string, string][] = [
  ["hold", "hold the output"],
  ["safe-value", "go to the safe value"],
  ["manual", "hold, and go to manual"],
];

/** How a vote stands, as the last record has it. */
export function VoteState({ loop, strategy }: { loop: string; strategy: string }) {
  const [vote, set_vote] = useState<Vote | null>(null);
  const votes = strategy.startsWith("vote");
  useEffect(() => {
    if (!votes) return;
    const look = (): void => {
      if (!document.hidden) get<Loop>(`/v1/loops/${encodeURIComponent(loop)}`).then((found) => set_vote(found.redundancy?.vote ?? null), () => undefined);
    };
    look();
    const every = setInterval(look, LOOK_MS);
    return () => clearInterval(every);
  }, [loop, votes]);
  if (!votes || !vote) return null;
  return (
    <>
      <dt>Vote</dt>
      <dd>
        {vote.agreed} of {vote.answers} agree, {vote.needed} needed
        {vote.dissents > 0 && `; ${vote.dissents} dissents`}
        {vote.aside.map((one) => (
          <p key={one.host} class="warn-text">
            {one.host} has no vote: {one.clean} clean steps in a row
          </p>
        ))}
      </dd>
    </>
  );
}

export function Redundancy({ spec, put }: { spec: Loop; put: (draft: LoopDraft) => Promise<void> }) {
  const now = spec.spec;
  const policy = now.policy as LoopDraft["policy"] & { on_fewer: string; on_fault: string; on_bad_input: string; faults_tolerated: number };
  const [library, set_library] = useState<Component[]>([]);
  const [open, set_open] = useState(false);
  const [replicas, set_replicas] = useState(String(now.replicas));
  const votes_now = /^vote\((\d+)\)$/.exec(now.strategy)?.[1] ?? "";
  const [votes, set_votes] = useState(votes_now);
  const [on_fewer, set_on_fewer] = useState(policy.on_fewer);
  const [on_fault, set_on_fault] = useState(policy.on_fault);
  const [on_bad_input, set_on_bad_input] = useState(policy.on_bad_input);
  const [tolerated, set_tolerated] = useState(String(policy.faults_tolerated));
  const [prefer, set_prefer] = useState<string[]>(now.prefer ?? []);
  const [fallback, set_fallback] = useState(now.fallback ?? "");
  useEffect(() => {
    if (open) list<Component>("/v1/components", "components").then(set_library, complain);
  }, [open]);
  const [n, m, t] = [number(replicas), number(votes), number(tolerated)];
  const whole = (x: number | null, least: number, most: number): boolean => x !== null && Number.isInteger(x) && x >= least && x <= most;
  const wrong = !whole(n, 1, REPLICAS_MAX) ? `replicas: 1 to ${REPLICAS_MAX}` : votes_now && !whole(m, 2, REPLICAS_MAX) ? `votes: 2 to ${REPLICAS_MAX}` : !whole(t, 0, 1_000_000) ? "faults: 0 or more" : "";
  const draft: LoopDraft = {
    ...now,
    replicas: n ?? now.replicas,
    strategy: votes_now && m ? `vote(${m})` : now.strategy,
    prefer,
    fallback: fallback || null,
    policy: { ...policy, on_fewer, on_fault, on_bad_input, faults_tolerated: t ?? policy.faults_tolerated },
  };
  // Parameters of a fallback that is another one now are not its own.
  if (fallback !== (now.fallback ?? "")) draft.fallback_parameters = {};
  const dirty = JSON.stringify({ ...draft, prefer }) !== JSON.stringify({ ...now, prefer: now.prefer ?? [], fallback: now.fallback || null });
  const names = [...new Set([...hosts.value.filter((host) => host.control).map((host) => host.name), ...hosts.value.flatMap((host) => host.labels ?? [])])].filter((name) => !prefer.includes(name));
  const known = library.some((one) => one.digest === fallback);
  return (
    <details class="panel" onToggle={(event) => set_open(event.currentTarget.open)}>
      <summary>
        <h2>Redundancy and faults</h2>
      </summary>
      <div class="grid4">
        <label class="field">
          <span>Replicas, hosts</span>
          <input inputMode="numeric" value={replicas} onInput={(event) => set_replicas(event.currentTarget.value)} />
        </label>
        {votes_now && (
          <>
            <label class="field">
              <span>Votes per cycle</span>
              <input inputMode="numeric" value={votes} onInput={(event) => set_votes(event.currentTarget.value)} />
            </label>
            <label class="field">
              <span>With fewer left</span>
              <select value={on_fewer} onChange={(event) => set_on_fewer(event.currentTarget.value)}>
                <option value="go-on">a majority of those left decides</option>
                <option value="fault">the cycle is a fault</option>
              </select>
            </label>
          </>
        )}
      </div>
      <fieldset>
        <legend>Preferred hosts, the best first; a better one gets the loop back once it has been well for 5 s</legend>
        <ol class="prefer">
          {prefer.map((name, at) => (
            <li key={name}>
              <span>{name}</span>
              <button type="button" class="plain" aria-label={`Prefer ${name} more`} disabled={at === 0} onClick={() => set_prefer(prefer.map((one, k) => (k === at - 1 ? name : k === at ? (prefer[at - 1] as string) : one)))}>
                ↑
              </button>
              <button type="button" class="plain" aria-label={`Do not prefer ${name}`} onClick={() => set_prefer(prefer.filter((one) => one !== name))}>
                ✕
              </button>
            </li>
          ))}
        </ol>
        <select aria-label="Prefer a host or a label" value="" disabled={prefer.length >= PREFERRED_MAX || names.length === 0} onChange={(event) => event.currentTarget.value && set_prefer([...prefer, event.currentTarget.value])}>
          <option value="">{prefer.length === 0 ? "none is preferred; add one" : "add one"}</option>
          {names.map((name) => (
            <option key={name}>{name}</option>
          ))}
        </select>
      </fieldset>
      <label class="field">
        <span>Fallback, takes over by itself after too many faults</span>
        <select value={fallback} onChange={(event) => set_fallback(event.currentTarget.value)}>
          <option value="">none</option>
          {fallback && !known && <option value={fallback}>{fallback.slice(0, 12)}…</option>}
          {library.map((one) => (
            <option key={one.digest} value={one.digest}>
              {one.name}@{one.version}
            </option>
          ))}
        </select>
      </label>
      <div class="grid4">
        <label class="field">
          <span>Faults that only hold</span>
          <input inputMode="numeric" value={tolerated} onInput={(event) => set_tolerated(event.currentTarget.value)} />
        </label>
        <label class="field">
          <span>After more</span>
          <select value={on_fault} onChange={(event) => set_on_fault(event.currentTarget.value)}>
            {ON_FAULT.map(([word, text]) => (
              <option key={word} value={word}>
                {text}
              </option>
            ))}
          </select>
        </label>
        <label class="field">
          <span>On a bad input</span>
          <select value={on_bad_input} onChange={(event) => set_on_bad_input(event.currentTarget.value)}>
            {ON_FAULT.map(([word, text]) => (
              <option key={word} value={word}>
                {text}
              </option>
            ))}
          </select>
        </label>
      </div>
      <Act off={!dirty || wrong !== ""} act={() => put(draft)}>
        {wrong || (dirty ? "Put in force" : "Nothing changed")}
      </Act>
    </details>
  );
}
