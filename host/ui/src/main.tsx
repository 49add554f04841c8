// The page: its frame, where one is in it, files that are dropped on it, keys that work everywhere.

import { effect, signal } from "@preact/signals";
import { render } from "preact";
import { useEffect, useRef } from "preact/hooks";
import { Events, Hosts, note_steps, Points } from "./cell";
import { Change, take_file } from "./change";
import { Face, NewLoop } from "./face";
import { clock, zone } from "./format";
import { here, hosts, link, loops, lost_at, notices, standing_alarms, start, tick, trouble } from "./live";
import { Library, take_into_library } from "./library";
import { Overview, abnormal } from "./overview";
import { Rollouts } from "./rollouts";
import "./style.css";
import { set_theme, show, theme } from "./theme";
import { complain, Dialog, Messages, undo_last } from "./ui";

const place = signal<string[]>([]);

function read_place(): void {
  place.value = location.hash.replace(/^#\/?/, "").split("/").map(decodeURIComponent);
}
addEventListener("hashchange", () => {
  read_place();
  // A new place begins at its top, and with its heading for those who listen.
  scrollTo(0, 0);
  document.getElementById("main")?.focus({ preventScroll: true });
});
read_place();

const VIEWS: [string, string][] = [
  ["", "Loops"],
  ["library", "Library"],
  ["hosts", "Hosts"],
  ["points", "Points"],
  ["events", "Events"],
  ["rollouts", "Rollouts"],
];

const help = signal(false);
const dragging = signal(false);

function View() {
  const [what = "", name = ""] = place.value;
  switch (what) {
    case "":
      return <Overview />;
    case "loop":
      return <Face name={name} />;
    case "change":
      return <Change name={name} />;
    case "new":
      return <NewLoop />;
    case "library":
      return <Library digest={name} />;
    case "hosts":
      return <Hosts />;
    case "points":
      return <Points />;
    case "events":
      return <Events />;
    case "rollouts":
      return <Rollouts id={name} />;
    default:
      return <p class="none">There is no such place.</p>;
  }
}

function Connection() {
  const state = link.value;
  const others = hosts.value.filter((host) => !host.here && host.alive && host.api);
  if (state === "live") return null;
  return (
    <div class="banner" role="alert">
      {state === "connecting" ? (
        "Connecting…"
      ) : (
        <>
          <b>Connection lost{lost_at.value ? ` at ${clock(lost_at.value)}` : ""}.</b> What you see is old. Trying again…{" "}
          {others.length > 0 && (
            <>
              Other hosts of the cell:{" "}
              {others.map((host) => (
                <a key={host.name} href={`${host.api}/${location.hash}`}>
                  {host.name}
                </a>
              ))}
            </>
          )}
        </>
      )}
    </div>
  );
}

/** What is urgent is said at once to those who listen to the page. */
function Urgent() {
  const last = notices.value.findLast((notice) => notice.weight === "urgent");
  const fresh = last && Date.now() - last.at_unix_us / 1_000 < 10_000;
  return (
    <div class="hidden" role="log" aria-live="assertive" aria-label="Urgent events">
      {fresh ? `${last.loop}: ${last.text}` : ""}
    </div>
  );
}

function Frame() {
  tick.value;
  const what = place.value[0] ?? "";
  const odd = [...loops.value.values()].filter((loop) => abnormal(loop).length > 0).length;
  const dead = hosts.value.filter((host) => !host.alive).length;
  const marks: Record<string, number> = { "": odd, hosts: dead, events: standing_alarms.value.length };
  const main = useRef<HTMLElement>(null);
  useEffect(() => {
    document.title = `${odd > 0 ? `(${odd}) ` : ""}${here.value ? `${here.value} – ` : ""}Bumpless`;
  }, [odd, here.value]);
  return (
    <>
      <a class="skip" href="#main" onClick={(event) => { event.preventDefault(); main.current?.focus(); }}>
        To the content
      </a>
      <header class="top">
        <a class="brand" href="#/" aria-label="Bumpless, all loops">
          <svg viewBox="0 0 32 32" aria-hidden="true">
            <path d="M3 21h8c3 0 3-10 6-10h12" />
            <circle cx="17" cy="11" r="3.2" />
          </svg>
          Bumpless
        </a>
        <nav aria-label="Places">
          {VIEWS.map(([id, name]) => {
            const current = what === id || (id === "" && ["loop", "change", "new"].includes(what));
            return (
              <a key={id} href={`#/${id}`} aria-current={current ? "page" : undefined}>
                {name}
                {marks[id] ? <b class="mark" aria-label={`${marks[id]} abnormal`}>{marks[id]}</b> : null}
              </a>
            );
          })}
        </nav>
        <div class="status">
          <span class={`link ${link.value}`}>
            <i />
            {link.value === "live" ? here.value : link.value}
          </span>
          <time>
            {clock(Date.now())} <small>{zone()}</small>
          </time>
          <button type="button" class="plain" aria-label={`Colours: ${theme.value}. Change`} title={`Colours: ${theme.value}`} onClick={() => set_theme(theme.value === "system" ? "dark" : theme.value === "dark" ? "light" : "system")}>
            {theme.value === "dark" ? "☾" : theme.value === "light" ? "☀" : "◐"}
          </button>
          <button type="button" class="plain" aria-label="Keys and help" onClick={() => (help.value = true)}>
            ?
          </button>
        </div>
      </header>
      <Connection />
      {trouble.value && link.value === "live" && (
        <div class="banner soft" role="alert">
          {trouble.value}
        </div>
      )}
      <main id="main" ref={main} tabIndex={-1} class={link.value === "live" ? "" : "stale"}>
        <View />
      </main>
      <Messages />
      <Urgent />
      {dragging.value && <div class="dropping">Drop the component: {what === "change" || what === "loop" ? `the way to change ${place.value[1]} begins` : "it goes to the library"}</div>}
      {help.value && (
        <Dialog title="Keys" close={() => (help.value = false)}>
          <dl>
            <dt>1 – 6</dt>
            <dd>Loops, Library, Hosts, Points, Events, Rollouts</dd>
            <dt>u</dt>
            <dd>take back the last setpoint, mode or tuning, while its message stands</dd>
            <dt>← → + − End</dt>
            <dd>in a trend: pan, zoom, now; with Shift, ← and → go from cycle to cycle</dd>
            <dt>?</dt>
            <dd>this</dd>
          </dl>
          <p>
            <a href="/addresses">Addresses of the API</a>
          </p>
        </Dialog>
      )}
    </>
  );
}

addEventListener("keydown", (event) => {
  const target = event.target as HTMLElement;
  if (event.ctrlKey || event.metaKey || event.altKey || target.closest("input, textarea, select, dialog")) return;
  const view = VIEWS[Number(event.key) - 1];
  if (view) location.hash = `#/${view[0]}`;
  else if (event.key === "u") undo_last();
  else if (event.key === "?") help.value = true;
});

const has_files = (event: DragEvent): boolean => event.dataTransfer?.types.includes("Files") ?? false;
addEventListener("dragover", (event) => {
  if (!has_files(event)) return;
  event.preventDefault();
  dragging.value = true;
});
addEventListener("dragleave", (event) => {
  if (!event.relatedTarget) dragging.value = false;
});
addEventListener("drop", (event) => {
  if (!has_files(event)) return;
  event.preventDefault();
  dragging.value = false;
  const file = event.dataTransfer?.files[0];
  if (!file) return;
  const [what, name] = place.value;
  if ((what === "loop" || what === "change") && name) {
    location.hash = `#/change/${name}`;
    take_file(name, file).catch(complain);
  } else {
    location.hash = "#/library";
    take_into_library(file).catch(complain);
  }
});

show();
start();
effect(() => {
  // With each beat of the hosts.
  hosts.value;
  note_steps();
});
const root = document.getElementById("page");
if (root) {
  root.textContent = "";
  render(<Frame />, root);
}
