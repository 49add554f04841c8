// The audit trail: who changed what, when and from where, with what it was and what it is. Chains of all hosts, merged by time.
//
// Never: changes anything; the chain is checked by the hosts, this page only shows what they found.

import { useEffect, useState } from "preact/hooks";
import { get } from "./api";
import { day, when, zone } from "./format";
import { link, loops } from "./live";
import type { AuditLine, AuditList, AuditProof } from "./types";
import { Act, complain, Dialog, None } from "./ui";

/** Entries of one answer. */
const PART = 100;
/** Entries that the page keeps at most; older ones are found by time. */
const KEPT_MAX = 2_000;
/** Changed fields that a row shows. */
const SHOWN_CHANGES = 3;

const SPANS: [string, number][] = [
  ["the last hour", 3_600],
  ["the last 8 hours", 28_800],
  ["the last day", 86_400],
  ["the last week", 604_800],
  ["all of it", 0],
];
const KINDS = ["loop", "component", "rollout", "point", "job", "alarm", "host", "modbus", "trail"];

interface Filter {
  span: number;
  loop: string;
  by: string;
  what: string;
}

function query(filter: Filter): URLSearchParams {
  const wanted = new URLSearchParams();
  if (filter.span > 0) wanted.set("from", new Date(Date.now() - filter.span * 1_000).toISOString());
  if (filter.loop) wanted.set("loop", filter.loop);
  if (filter.by.trim()) wanted.set("by", filter.by.trim());
  if (filter.what) wanted.set("what", filter.what);
  return wanted;
}

/** A value of a change, short. */
function short(x: unknown): string {
  if (x === null || x === undefined) return "–";
  const text = typeof x === "string" ? x : JSON.stringify(x);
  return text.length > 80 ? `${text.slice(0, 79)}…` : text;
}

const key_of = (line: AuditLine): string => `${line.host} ${line.number}`;

export function Audit() {
  const [filter, set_filter] = useState<Filter>({ span: 86_400, loop: "", by: "", what: "" });
  const [only_failed, set_only_failed] = useState(false);
  const [lines, set_lines] = useState<AuditLine[] | null>(null);
  const [next, set_next] = useState<string | null>(null);
  const [silent, set_silent] = useState<{ host: string; reason: string }[]>([]);
  const [open, set_open] = useState<AuditLine | null>(null);
  const put = (part: Partial<Filter>): void => set_filter({ ...filter, ...part });

  const read = async (after: string | null): Promise<void> => {
    const wanted = query(filter);
    wanted.set("limit", String(PART));
    if (after) wanted.set("after", after);
    const list = await get<AuditList>(`/v1/audit?${wanted}`);
    set_lines((old) => [...(after ? (old ?? []) : []), ...list.entries].slice(0, KEPT_MAX));
    set_next(list.next);
    set_silent(list.silent ?? []);
  };
  const wanted = JSON.stringify(filter);
  useEffect(() => {
    let dead = false;
    // While somebody types, one question is enough.
    const late = setTimeout(() => {
      if (!dead) read(null).catch(complain);
    }, 200);
    return () => {
      dead = true;
      clearTimeout(late);
    };
  }, [wanted, link.value === "live"]);

  const shown = (lines ?? []).filter((line) => !only_failed || line.outcome !== "done");
  const names = [...loops.value.keys()].sort((a, b) => a.localeCompare(b, undefined, { numeric: true }));
  return (
    <>
      <div class="head">
        <h1>Audit</h1>
        <p class="quiet">who changed what, times in {zone()}</p>
      </div>
      <Proof />
      <div class="row wrap above filters">
        <label class="field">
          <span>From</span>
          <select value={String(filter.span)} onChange={(event) => put({ span: Number(event.currentTarget.value) })}>
            {SPANS.map(([words, s]) => (
              <option key={s} value={String(s)}>
                {words}
              </option>
            ))}
          </select>
        </label>
        <label class="field">
          <span>Loop</span>
          <select value={filter.loop} onChange={(event) => put({ loop: event.currentTarget.value })}>
            <option value="">all, and what is of no loop</option>
            {names.map((name) => (
              <option key={name}>{name}</option>
            ))}
          </select>
        </label>
        <label class="field">
          <span>What</span>
          <select value={filter.what} onChange={(event) => put({ what: event.currentTarget.value })}>
            <option value="">everything</option>
            {KINDS.map((kind) => (
              <option key={kind}>{kind}</option>
            ))}
          </select>
        </label>
        <label class="field">
          <span>By</span>
          <input value={filter.by} placeholder="anybody" onInput={(event) => put({ by: event.currentTarget.value })} />
        </label>
        <label class="check sit">
          <input type="checkbox" checked={only_failed} onChange={(event) => set_only_failed(event.currentTarget.checked)} /> only what failed
        </label>
        <span class="row end grow sit">
          <a class="button" title="all of that time, as a table" href={`/v1/audit/export?${exported(filter, "csv")}`} download="audit.csv">
            Export CSV
          </a>
          <a class="button" title="all of that time with its hashes, for bumpless audit verify" href={`/v1/audit/export?${exported(filter, "jsonl")}`} download="audit.jsonl">
            Export JSON
          </a>
        </span>
      </div>
      {silent.map((one) => (
        <p key={one.host} class="warn-text" role="status">
          {one.host} does not answer, so what entered through it is not here: {one.reason}
        </p>
      ))}
      {lines && shown.length === 0 && <None what="Nothing that fits." />}
      {shown.length > 0 && (
        <div class="scroll" tabIndex={0} role="region" aria-label="Table of changes">
          <table class="list stack audit">
            <thead>
              <tr>
                <th>When</th>
                <th>What</th>
                <th>Of</th>
                <th>Before → after</th>
                <th>By</th>
                <th>Outcome</th>
              </tr>
            </thead>
            <tbody>
              {shown.map((line) => (
                <tr key={key_of(line)}>
                  <td class="when">
                    <time dateTime={line.at} title={`${day(Date.parse(line.at))} ${zone(Date.parse(line.at))}`}>
                      {when(Date.parse(line.at))}
                    </time>
                  </td>
                  <th scope="row">
                    <button type="button" class="link-button" aria-label={`${line.what}, entry ${line.number} of ${line.host}`} onClick={() => set_open(line)}>
                      {line.what}
                    </button>
                  </th>
                  <td>
                    {line.loop && <a href={`#/loop/${line.loop}`}>{line.loop}</a>} {line.target !== line.loop && line.target}
                  </td>
                  <td>
                    {line.changes.slice(0, SHOWN_CHANGES).map((change) => (
                      <p key={change.field} class="change">
                        <span>{change.field}</span> {short(change.before)} <b aria-label="became">→</b> {short(change.after)}
                      </p>
                    ))}
                    {line.changes.length > SHOWN_CHANGES && <small>and {line.changes.length - SHOWN_CHANGES} more</small>}
                  </td>
                  <td>
                    {line.by || <span class="quiet">nobody named</span>} <small>{line.via}</small>
                  </td>
                  <td class={line.outcome === "done" ? "" : "warn-text"}>
                    {line.outcome}
                    {line.reason && <small> {line.reason}</small>}
                  </td>
                </tr>
              ))}
            </tbody>
          </table>
        </div>
      )}
      {next && lines && lines.length < KEPT_MAX && (
        <div class="row above">
          <Act act={() => read(next)}>Older ones</Act>
        </div>
      )}
      {open && <Entry line={open} close={() => set_open(null)} />}
    </>
  );
}

function exported(filter: Filter, format: string): string {
  // A chain is exported whole between two times: what is left out of it could not be checked.
  const wanted = query({ ...filter, loop: "", by: "", what: "" });
  wanted.set("format", format);
  return wanted.toString();
}

/** Are the chains whole? Asked once, and again when somebody wants to know. */
function Proof() {
  const [proof, set_proof] = useState<AuditProof | null>(null);
  const [at, set_at] = useState(0);
  const ask = async (): Promise<void> => {
    set_proof(await get<AuditProof>("/v1/audit/verify"));
    set_at(Date.now());
  };
  useEffect(() => {
    ask().catch(complain);
  }, []);
  const broken = (proof?.chains ?? []).filter((chain) => !chain.good);
  const silent = proof?.silent ?? [];
  const entries = (chain: AuditProof["chains"][number]): number => (chain.first === 0 ? 0 : chain.last - chain.first + 1);
  return (
    <section class={`panel proof${broken.length > 0 ? " grave" : ""}`} aria-label="Is the trail whole?">
      <div class="row wrap">
        <p class="grow">
          {proof === null
            ? "The chains are being checked…"
            : broken.length === 0
              ? `${silent.length > 0 ? "The chains that could be checked are whole" : "The chains are whole"}: ${proof.chains.map((chain) => `${chain.host} ${entries(chain)}`).join(", ")} entries.`
              : broken.map((chain) => `The chain of ${chain.host} does not fit${chain.flaw ? `: ${chain.flaw.reason} (${chain.flaw.segment} line ${chain.flaw.line})` : ""}.`).join(" ")}
          {silent.map((one) => (
            <span key={one.host} class="warn-text">
              {" "}
              {one.host} does not answer.
            </span>
          ))}
          {at > 0 && <small> checked {when(at)}</small>}
        </p>
        <Act class="small" act={ask}>
          Check again
        </Act>
      </div>
    </section>
  );
}

function Entry({ line, close }: { line: AuditLine; close: () => void }) {
  return (
    <Dialog title={`${line.what}, entry ${line.number} of ${line.host}`} close={close} wide>
      <dl>
        <dt>When</dt>
        <dd>
          {day(Date.parse(line.at))} {when(Date.parse(line.at))} {zone(Date.parse(line.at))}, took {line.took_ms} ms
        </dd>
        <dt>By</dt>
        <dd>
          {line.by || "nobody named"}, over {line.via}
          {line.from && ` from ${line.from}`}
        </dd>
        <dt>Of</dt>
        <dd>{[line.loop, line.target !== line.loop ? line.target : ""].filter(Boolean).join(", ") || "–"}</dd>
        <dt>Outcome</dt>
        <dd class={line.outcome === "done" ? "" : "warn-text"}>
          {line.outcome}
          {line.reason && `: ${line.reason}`}
        </dd>
      </dl>
      {line.changes.length > 0 && (
        <div class="scroll" tabIndex={0} role="region" aria-label="Table of fields">
          <table class="list">
            <thead>
              <tr>
                <th>Field</th>
                <th>Before</th>
                <th>After</th>
              </tr>
            </thead>
            <tbody>
              {line.changes.map((change) => (
                <tr key={change.field}>
                  <th scope="row">{change.field}</th>
                  <td>{short(change.before)}</td>
                  <td>{short(change.after)}</td>
                </tr>
              ))}
            </tbody>
          </table>
        </div>
      )}
      <details>
        <summary>What was asked for</summary>
        <pre class="code-block">{JSON.stringify(line.asked, null, 2)}</pre>
      </details>
      <p class="digest">
        {line.hash}
        <br />
        after {line.prev}
      </p>
    </Dialog>
  );
}
