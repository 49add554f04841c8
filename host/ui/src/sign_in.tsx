// The form before the page, where the host wants to know who one is.
// Never: says which of name and password was wrong; the host does not either.

import { createContext, type ComponentChildren } from "preact";
import { useContext, useState } from "preact/hooks";
import { make_first, may, me, type Role, sign_in, sign_out } from "./access";

/** What acts need in a part of the page: a role, and the loop that they are about. */
const Needs = createContext<{ role: Role; loop?: string }>({ role: "viewer" });

/** All acts within need this. */
export function Needing(props: { role: Role; loop?: string; children: ComponentChildren }) {
  return <Needs.Provider value={{ role: props.role, loop: props.loop }}>{props.children}</Needs.Provider>;
}

/** Why an act cannot be done here by the one who looks at it; empty where it can. */
export function useRefusal(): string {
  const { role, loop } = useContext(Needs);
  if (may(role, loop)) return "";
  return loop && may(role, "") ? `you may not change ${loop}` : `this needs the role ${role}${loop ? "" : ", for all loops"}`;
}

export function SignIn() {
  const first = me.value?.first ?? false;
  const [token, set_token] = useState("");
  const [name, set_name] = useState("");
  const [password, set_password] = useState("");
  const [wrong, set_wrong] = useState("");
  const [busy, set_busy] = useState(false);
  const go = async (): Promise<void> => {
    set_busy(true);
    set_wrong("");
    try {
      await (first ? make_first(token, name, password) : sign_in(name, password));
    } catch (error) {
      set_wrong(error instanceof Error ? error.message : String(error));
    } finally {
      set_password("");
      set_busy(false);
    }
  };
  return (
    <main id="main" class="sign-in">
      <h1>Bumpless</h1>
      <p>{first ? "This cell has no administrator yet. The token lies in the file first-token in the host's data folder." : "This host wants to know who you are."}</p>
      <form
        onSubmit={(event) => {
          event.preventDefault();
          void go();
        }}
      >
        {first && (
          <label class="field">
            <span>First-boot token</span>
            <input required type="password" autocomplete="off" value={token} onInput={(event) => set_token(event.currentTarget.value)} />
          </label>
        )}
        <label class="field">
          <span>Name</span>
          <input required autocomplete="username" autocapitalize="none" spellcheck={false} value={name} onInput={(event) => set_name(event.currentTarget.value)} />
        </label>
        <label class="field">
          <span>{first ? "Password, 10 characters or more" : "Password"}</span>
          <input required type="password" autocomplete={first ? "new-password" : "current-password"} value={password} onInput={(event) => set_password(event.currentTarget.value)} />
        </label>
        {wrong && (
          <p class="wrong" role="alert">
            {wrong}
          </p>
        )}
        <button type="submit" disabled={busy}>
          {first ? "Make the administrator" : "Sign in"}
        </button>
      </form>
    </main>
  );
}

/** Who is signed in, and the way out. */
export function Signed(props: { close: () => void }) {
  const now = me.value;
  const all = now?.loops.includes("*");
  return (
    <>
      <p>
        You are <b>{now?.name}</b>, {now?.role}
        {now?.role !== "viewer" && (all ? "." : `, for ${now?.loops.join(", ") || "no loop"}.`)} What you do is written down under this name.
      </p>
      <div class="row end">
        <button type="button" onClick={props.close}>
          Close
        </button>
        <button type="button" onClick={() => void sign_out()}>
          Sign out
        </button>
      </div>
    </>
  );
}
