// The library: what was uploaded, how its trial went, where it is ready, who uses it.

import { signal } from "@preact/signals";
import { useEffect, useRef, useState } from "preact/hooks";
import { get, list, remove, send, upload, words } from "./api";
import { AdmissionReport } from "./change";
import { bytes, when, zone } from "./format";
import { loops } from "./live";
import type { Component } from "./types";
import { Act, complain, Danger, None, say } from "./ui";
import { by } from "./who";

const all = signal<Component[]>([]);
const busy = signal("");
const refusal = signal<{ file: File; text: string } | null>(null);
const text_filter = signal("");

async function load(): Promise<void> {
  try {
    all.value = await list<Component>("/v1/components", "components");
  } catch (error) {
    complain(error);
  }
}

/** Uploads a file into the library. */
export async function take_into_library(file: File, force = false): Promise<void> {
  refusal.value = null;
  busy.value = `${file.name} is being tried on made-up frames…`;
  try {
    const component = await upload<Component>(file, { force });
    await load();
    say(`${component.name}@${component.version} is in the library.`);
    location.hash = `#/library/${component.digest}`;
  } catch (error) {
    refusal.value = { file, text: words(error) };
  } finally {
    busy.value = "";
  }
}

export function Library(props: { digest: string }) {
  const input = useRef<HTMLInputElement>(null);
  useEffect(() => {
    void load();
    const every = setInterval(() => void load(), 10_000);
    return () => clearInterval(every);
  }, []);
  const wanted = text_filter.value.trim().toLowerCase();
  const shown = all.value.filter((one) => `${one.name}@${one.version} ${one.text} ${one.note} ${Object.entries(one.labels).flat().join(" ")}`.toLowerCase().includes(wanted));
  return (
    <>
      <div class="head">
        <h1>Library</h1>
        <p class="quiet">{all.value.length} components</p>
        <div class="row end grow">
          <input type="search" class="short" placeholder="filter" aria-label="Filter components" value={text_filter.value} onInput={(event) => (text_filter.value = event.currentTarget.value)} />
          <a class="button" href="/v1/bundle" download="components.tar">
            Export all
          </a>
          <input ref={input} type="file" accept=".wasm,application/wasm" class="hidden" tabIndex={-1} aria-label="Component file" onChange={(event) => {
            const file = event.currentTarget.files?.[0];
            if (file) void take_into_library(file);
            event.currentTarget.value = "";
          }} />
          <button type="button" class="primary" onClick={() => input.current?.click()}>
            Upload…
          </button>
        </div>
      </div>
      {busy.value && <p role="status" class="busy">{busy.value}</p>}
      {refusal.value && (
        <div role="alert" class="refusal">
          <p>
            {refusal.value.file.name} was not taken in: {refusal.value.text}
          </p>
          <Danger label="Take it in anyway" title="Take in what failed its trial?" text="It may trap, spin or write nonsense in service; the loop's policy then decides. Its report will say that it came in by force." name="force" act={() => take_into_library((refusal.value as { file: File }).file, true)} />
        </div>
      )}
      <div class={props.digest ? "split" : ""}>
        <div class="scroll" tabIndex={0} role="region" aria-label="Table of components">
          <table class="list">
            <thead>
              <tr>
                <th>Component</th>
                <th>Trial</th>
                <th>Ready on</th>
                <th>Used by</th>
                <th>Labels</th>
                <th>Uploaded</th>
              </tr>
            </thead>
            <tbody>
              {shown.map((one) => (
                <tr key={one.digest} class={one.digest === props.digest ? "chosen" : ""}>
                  <th scope="row">
                    <a href={`#/library/${one.digest}`}>
                      {one.name}@{one.version}
                    </a>
                    <br />
                    <small>{one.text}</small>
                  </th>
                  <td>{one.admission?.verdict ?? "none"}</td>
                  <td>{one.ready_on.join(", ")}</td>
                  <td>{one.used_by.join(", ")}</td>
                  <td>{Object.entries(one.labels).map(([key, text]) => `${key}=${text}`).join(", ")}</td>
                  <td>
                    {when(one.uploaded_at_unix_ms)}
                    <br />
                    <small>
                      {one.uploaded_by}, {bytes(one.size_bytes)}
                    </small>
                  </td>
                </tr>
              ))}
            </tbody>
          </table>
          {shown.length === 0 && <None what="Nothing here. Drop a .wasm component anywhere on this page." />}
        </div>
        {props.digest && <One key={props.digest} digest={props.digest} />}
      </div>
    </>
  );
}

function One({ digest }: { digest: string }) {
  const [one, set_one] = useState<Component | null>(null);
  const [note, set_note] = useState("");
  const [label, set_label] = useState("");
  const [loop, set_loop] = useState("");
  const path = `/v1/components/${digest}`;
  const again = (): Promise<void> => get<Component>(path).then((found) => { set_one(found); set_note(found.note); }, complain);
  useEffect(() => void again(), [digest]);
  if (!one) return <aside class="panel">Loading…</aside>;
  return (
    <aside class="panel" aria-label={`${one.name}@${one.version}`}>
      <div class="row">
        <h2 class="grow">
          {one.name}@{one.version}
        </h2>
        <a class="plain" href="#/library" aria-label="Close">
          ✕
        </a>
      </div>
      <p>{one.text}</p>
      <p class="digest">{one.digest}</p>
      <AdmissionReport admission={one.admission} />
      <div class="enter">
        <label class="field">
          <span>Try it on a loop</span>
          <select value={loop} onChange={(event) => set_loop(event.currentTarget.value)}>
            <option value="">choose a loop</option>
            {[...loops.value.keys()].sort().map((name) => (
              <option key={name}>{name}</option>
            ))}
          </select>
        </label>
        <a class="button" aria-disabled={!loop} href={loop ? `#/change/${loop}` : "#/library"}>
          Go
        </a>
      </div>
      <h3>Hosts</h3>
      <ul class="plain-list">
        {(one.hosts ?? []).map((host) => (
          <li key={host.host}>
            {host.host}: <b class={host.stage === "failed" ? "urgent-text" : ""}>{host.stage}</b> {host.reason}
          </li>
        ))}
      </ul>
      <h3>Ports</h3>
      <ul class="plain-list">
        {one.ports.map((port) => (
          <li key={port.name}>
            <b>{port.name}</b> {port.direction} {port.unit && `(${port.unit})`} {port.required ? "" : "optional"} — {port.text}
          </li>
        ))}
      </ul>
      <h3>Note and labels</h3>
      <form class="enter" onSubmit={(event) => { event.preventDefault(); }}>
        <label class="field">
          <span>Note</span>
          <input value={note} onInput={(event) => set_note(event.currentTarget.value)} />
        </label>
        <Act off={note === one.note} act={async () => {
          const before = one.note;
          await send("PATCH", path, { note, by: by() });
          await again();
          say("Note kept.", async () => { await send("PATCH", path, { note: before, by: by() }); await again(); });
        }}>
          Keep
        </Act>
      </form>
      <div class="row wrap">
        {Object.entries(one.labels).map(([key, text]) => (
          <Act key={key} class="small" label={`Remove label ${key}`} act={async () => {
            await send("PATCH", path, { labels: { [key]: null }, by: by() });
            await again();
            say(`Label ${key} removed.`, async () => { await send("PATCH", path, { labels: { [key]: text }, by: by() }); await again(); });
          }}>
            {key}={text} ✕
          </Act>
        ))}
      </div>
      <form class="enter" onSubmit={(event) => event.preventDefault()}>
        <input aria-label="New label, key=value" placeholder="key=value" value={label} onInput={(event) => set_label(event.currentTarget.value)} />
        <Act off={!/^[^=]+=.+$/.test(label)} act={async () => {
          const [key, ...rest] = label.split("=");
          await send("PATCH", path, { labels: { [key as string]: rest.join("=") }, by: by() });
          set_label("");
          await again();
        }}>
          Add
        </Act>
      </form>
      <h3>History</h3>
      <ol class="events" tabIndex={0}>
        {[...one.history].reverse().map((event) => (
          <li key={`${event.at_unix_ms}-${event.what}`}>
            <time title={zone(event.at_unix_ms)}>{when(event.at_unix_ms)}</time>
            <span>
              {event.what} ({event.by})
            </span>
          </li>
        ))}
      </ol>
      <div class="row wrap">
        <a class="button" href={`${path}/bytes`} download={`${one.name}-${one.version}.wasm`}>
          Download
        </a>
        <Danger label="Delete" title={`Delete ${one.name}@${one.version}?`} text="It goes from the library of every host. Loops that use it keep it from going." name={one.name} act={async () => {
          await remove(path);
          location.hash = "#/library";
          await load();
          say(`${one.name}@${one.version} is deleted.`);
        }} />
      </div>
    </aside>
  );
}
