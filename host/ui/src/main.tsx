// The page: its frame, where one is in it, files that are dropped on it, keys that work everywhere.

import { effect, signal } from "@preact/signals";
import { render } from "preact";
import { useEffect, useRef } from "preact/hooks";
import { keep_looking, look, me, must_sign_in } from "./access";
import { follow_alarms, unseen } from "./alarms";
import { Bell } from "./alarm_parts";
import { Alarms, FloodBanner } from "./alarms_view";
import { Audit } from "./audit";
import { Events, Hosts, note_steps } from "./cell";
import { Change, take_file } from "./change";
import { Face, NewLoop } from "./face";
import { Lab } from "./lab";
import { NameField } from "./name";
import { Points } from "./points";
import { clock, zone } from "./format";
import { forced, here, hosts, link, loops, lost_at, notices, start, tick, trouble } from "./live";
import { Library, take_into_library } from "./library";
import { Overview, abnormal } from "./overview";
import { Rollouts } from "./rollouts";
import { Needing, Signed, SignIn } from "./sign_in";
import "./style.css";
import { set_theme, show, theme } from "./theme";
import { complain, Dialog, Messages, undo_last } from "./ui";
import { who } from "./who";

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
  ["alarms", "Alarms"],
  ["hosts", "Hosts"],
  ["points", "Points"],
  ["events", "Events"],
  ["library", "Library"],
  ["rollouts", "Rollouts"],
  ["lab", "Lab"],
  ["audit", "Audit"],
];

const help = signal(false);
const naming = signal(false);
const dragging = signal(false);

function View() {
  const [what = "", name = ""] = place.value;
  // Lists have an act beside each loop; whether it is one's own is the host's to say.
  const about = ["loop", "change"].includes(what) ? name : ["", "alarms"].includes(what) ? "" : undefined;
  return (
    <Needing role={ROLES[what] ?? "engineer"} loop={about}>
      <Place what={what} name={name} />
    </Needing>
  );
}

/** What acts of a place need where nothing narrower is said; of the others, an engineer. */
const ROLES: Record<string, "viewer" | "operator"> = { "": "operator", alarms: "operator", events: "viewer", lab: "viewer", audit: "viewer" };

function Place({ what, name }: { what: string; name: string }) {
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
    case "alarms":
      return <Alarms tab={name} />;
    case "lab":
      return <Lab name={name} />;
    case "audit":
      return <Audit />;
    case "hosts":
      return <Hosts />;
    case "points":
      return <Points tab={name} />;
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
  const alarm = unseen.value.find((one) => one.priority === "high" && one.came_unix_ms !== null && Date.now() - one.came_unix_ms < 10_000);
  return (
    <div class="hidden" role="log" aria-live="assertive" aria-label="Urgent events">
      {alarm ? `Alarm ${alarm.name} of ${alarm.loop}, high priority` : fresh ? `${last.loop}: ${last.text}` : ""}
    </div>
  );
}

function Frame() {
  tick.value;
  const what = place.value[0] ?? "";
  const odd = [...loops.value.values()].filter((loop) => abnormal(loop).length > 0).length;
  const dead = hosts.value.filter((host) => !host.alive).length;
  const marks: Record<string, [number, string]> = {
    "": [odd, "abnormal"],
    hosts: [dead, "not alive"],
    points: [forced.value.length, "forced"],
  };
  const waiting = unseen.value.length;
  const main = useRef<HTMLElement>(null);
  useEffect(() => {
    document.title = `${waiting > 0 ? `▲${waiting} ` : ""}${odd > 0 ? `(${odd}) ` : ""}${here.value ? `${here.value} – ` : ""}Bumpless`;
  }, [odd, waiting, here.value]);
  useEffect(() => {
    // Where places do not fit side by side, the one that is looked at is in view.
    document.querySelector(".top nav a[aria-current]")?.scrollIntoView({ block: "nearest", inline: "nearest" });
  }, [what]);
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
            const [count, kind] = marks[id] ?? [0, ""];
            const current = what === id || (id === "" && ["loop", "change", "new"].includes(what));
            return (
              <a key={id} href={`#/${id}`} aria-current={current ? "page" : undefined}>
                {name}
                {count > 0 && (
                  <b class="mark" aria-label={`${count} ${kind}`}>
                    {count}
                  </b>
                )}
              </a>
            );
          })}
        </nav>
        <Bell />
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
          {me.value?.name ? (
            <button type="button" class="plain who-button" title="who you are, and the way out" onClick={() => (naming.value = true)}>
              {me.value.name} <small>{me.value.role}</small>
            </button>
          ) : (
            <button type="button" class="plain who-button" aria-label={`${who.value || "no name"}: your name, for the record. Change`} title="your name, for the record; nobody is asked here" onClick={() => (naming.value = true)}>
              {who.value || "no name"}
            </button>
          )}
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
      <FloodBanner />
      <main id="main" ref={main} tabIndex={-1} class={link.value === "live" ? "" : "stale"}>
        <View />
      </main>
      <Messages />
      <Urgent />
      {dragging.value && <div class="dropping">Drop the component: {what === "change" || what === "loop" ? `the way to change ${place.value[1]} begins` : "it goes to the library"}</div>}
      {naming.value && (me.value?.name ? <Dialog title="Signed in" close={() => (naming.value = false)}><Signed close={() => (naming.value = false)} /></Dialog> : <Naming />)}
      {help.value && (
        <Dialog title="Keys" close={() => (help.value = false)}>
          <dl>
            <dt>1 – 9</dt>
            <dd>{VIEWS.map(([, name]) => name).join(", ")}</dd>
            <dt>a</dt>
            <dd>the alarms</dd>
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

function Naming() {
  return (
    <Dialog title="Who are you?" close={() => (naming.value = false)}>
      <p>A name that goes with what you do: acknowledging, forcing, changing. It proves nothing, and it is kept in this browser: this host asks nobody who he is, so whoever reaches it may do everything.</p>
      <form
        method="dialog"
        class="enter"
        onSubmit={(event) => {
          event.preventDefault();
          naming.value = false;
        }}
      >
        <NameField />
        <button type="submit">Done</button>
      </form>
    </Dialog>
  );
}

addEventListener("keydown", (event) => {
  const target = event.target as HTMLElement;
  if (event.ctrlKey || event.metaKey || event.altKey || target.closest("input, textarea, select, dialog")) return;
  const view = VIEWS[Number(event.key) - 1];
  if (view) location.hash = `#/${view[0]}`;
  else if (event.key === "a") location.hash = "#/alarms";
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

/** The page, once the host knows who looks at it. */
function Page() {
  if (me.value === null) return <p class="none">Asking the host…</p>;
  return must_sign_in.value ? <SignIn /> : <Frame />;
}

let started = false;
/** Begins to follow the cell: once, and not before the host would answer. */
function begin(): void {
  if (started) return;
  started = true;
  start();
  follow_alarms();
  effect(() => {
    // With each beat of the hosts.
    hosts.value;
    note_steps();
  });
}

show();
effect(() => {
  if (me.value !== null && !must_sign_in.value) begin();
});
const root = document.getElementById("page");
if (root) {
  root.textContent = "";
  render(<Page />, root);
}
/** Pause before a host that did not answer is asked again, in ms. */
const AGAIN_MS = 2_000;
async function ask_first(): Promise<void> {
  while (me.peek() === null) {
    try {
      await look();
    } catch {
      await new Promise((resolve) => setTimeout(resolve, AGAIN_MS));
    }
  }
  keep_looking();
}
void ask_first();
