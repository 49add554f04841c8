// The page's own small parts: buttons that wait, dialogs, confirmation by typing, messages with undo, bars.

import { signal } from "@preact/signals";
import type { ComponentChildren } from "preact";
import { useEffect, useId, useRef, useState } from "preact/hooks";
import { words } from "./api";
import { value } from "./format";
import { link } from "./live";
import { useRefusal } from "./sign_in";
import type { Limit } from "./alarms";

/** A message at the lower edge. */
interface Message {
  id: number;
  text: string;
  bad: boolean;
  undo?: () => Promise<unknown>;
}
export const messages = signal<Message[]>([]);
let next_message = 1;

/** How long a message stays, in ms, and one that offers to take something back; bad ones stay until they are closed. */
const MESSAGE_MS = 10_000;
const UNDO_MS = 30_000;

export function say(text: string, undo?: () => Promise<unknown>): void {
  put({ id: next_message++, text, bad: false, undo });
}

export function complain(error: unknown): void {
  put({ id: next_message++, text: words(error), bad: true });
}

function put(message: Message): void {
  messages.value = [...messages.value.slice(-3), message];
  if (!message.bad) setTimeout(() => drop(message.id), message.undo ? UNDO_MS : MESSAGE_MS);
}

function drop(id: number): void {
  messages.value = messages.value.filter((message) => message.id !== id);
}

/** Takes back the last act that can be. */
export function undo_last(): void {
  const last = messages.value.findLast((message) => message.undo);
  if (last) void take_back(last);
}

async function take_back(message: Message): Promise<void> {
  drop(message.id);
  try {
    await message.undo?.();
    say("Taken back.");
  } catch (error) {
    complain(error);
  }
}

export function Messages() {
  return (
    <div class="messages" role="status" aria-live="polite">
      {messages.value.map((message) => (
        <div key={message.id} class={message.bad ? "message bad" : "message"} role={message.bad ? "alert" : undefined}>
          <span>{message.text}</span>
          {message.undo && (
            <button type="button" class="plain" onClick={() => void take_back(message)}>
              Undo
            </button>
          )}
          <button type="button" class="plain" aria-label="Close message" onClick={() => drop(message.id)}>
            ✕
          </button>
        </div>
      ))}
    </div>
  );
}

/** Does something when pressed, and waits for it: no second press meanwhile. Off while the connection is. */
export function Act(props: {
  children: ComponentChildren;
  act: () => Promise<unknown>;
  class?: string;
  off?: boolean;
  label?: string;
  title?: string;
  pressed?: boolean;
}) {
  const [busy, set_busy] = useState(false);
  const refusal = useRefusal();
  const go = async (): Promise<void> => {
    set_busy(true);
    try {
      await props.act();
    } catch (error) {
      complain(error);
    } finally {
      set_busy(false);
    }
  };
  return (
    <button
      type="button"
      class={props.class}
      disabled={busy || props.off || link.value !== "live" || refusal !== ""}
      aria-busy={busy}
      aria-label={props.label}
      aria-pressed={props.pressed}
      title={refusal || props.title}
      onClick={() => void go()}
    >
      {props.children}
    </button>
  );
}

/** A dialog of the browser's own: it keeps the focus and closes with Escape. */
export function Dialog(props: { title: string; close: () => void; children: ComponentChildren; wide?: boolean }) {
  const dialog = useRef<HTMLDialogElement>(null);
  const gone = useRef(false);
  const id = useId();
  useEffect(() => {
    const element = dialog.current;
    if (element && !element.open) element.showModal();
    return () => {
      // Its close event comes later; what took its place must not hear it.
      gone.current = true;
      element?.close();
    };
  }, []);
  return (
    <dialog ref={dialog} class={props.wide ? "wide" : undefined} aria-labelledby={id} onClose={() => { if (!gone.current) props.close(); }}>
      <header>
        <h2 id={id}>{props.title}</h2>
        <button type="button" class="plain" aria-label="Close" onClick={props.close}>
          ✕
        </button>
      </header>
      {props.children}
    </dialog>
  );
}

/** What cannot be taken back: the name must be typed. */
export function Danger(props: { label: string; title: string; text: string; name: string; act: () => Promise<unknown>; off?: boolean }) {
  const [open, set_open] = useState(false);
  const [typed, set_typed] = useState("");
  const refusal = useRefusal();
  return (
    <>
      <button type="button" class="danger" title={refusal || undefined} disabled={props.off || link.value !== "live" || refusal !== ""} onClick={() => set_open(true)}>
        {props.label}
      </button>
      {open && (
        <Dialog title={props.title} close={() => set_open(false)}>
          <p>{props.text}</p>
          <label class="field">
            <span>
              Type <b>{props.name}</b> to go on
            </span>
            <input autocomplete="off" value={typed} onInput={(event) => set_typed(event.currentTarget.value)} />
          </label>
          <div class="row end">
            <button type="button" onClick={() => set_open(false)}>
              Cancel
            </button>
            <Act
              class="danger"
              off={typed !== props.name}
              act={async () => {
                await props.act();
                set_open(false);
                set_typed("");
              }}
            >
              {props.label}
            </Act>
          </div>
        </Dialog>
      )}
    </>
  );
}

/** A value in its range, with a mark for what is wanted. Said in words to those who do not see it. */
export function Bar(props: { label: string; at: number | null; mark?: number | null; low: number; high: number; unit: string; kind: "pv" | "out"; limits?: Limit[] }) {
  const part = (x: number | null | undefined): number =>
    x === null || x === undefined || !(props.high > props.low) ? 0 : Math.min(1, Math.max(0, (x - props.low) / (props.high - props.low)));
  const span = props.high - props.low;
  return (
    <div
      class={`bar ${props.kind}`}
      role="meter"
      aria-label={props.label}
      aria-valuemin={props.low}
      aria-valuemax={props.high}
      aria-valuenow={props.at ?? undefined}
      aria-valuetext={`${value(props.at, span)} ${props.unit}`}
    >
      <i style={{ width: `${(100 * part(props.at)).toFixed(1)}%` }} />
      {props.limits
        ?.filter((limit) => limit.at >= props.low && limit.at <= props.high)
        .map((limit) => <u key={limit.name} class={limit.on ? `on ${limit.priority}` : ""} title={`${limit.name}: ${limit.kind} ${value(limit.at, span)} ${props.unit}`} style={{ left: `${(100 * part(limit.at)).toFixed(1)}%` }} />)}
      {props.mark !== null && props.mark !== undefined && <b style={{ left: `${(100 * part(props.mark)).toFixed(1)}%` }} />}
    </div>
  );
}

/** A table's rows or the words that there are none. */
export function None(props: { what: string }) {
  return <p class="none">{props.what}</p>;
}
