// The field for the operator's name, wherever a name goes on record; one name for the whole page.

import { set_who, who, WHO_CHARS_MAX } from "./who";

export function NameField() {
  return (
    <label class="field">
      <span>Your name, for the record</span>
      <input autocomplete="name" maxLength={WHO_CHARS_MAX} placeholder="page" value={who.value} onInput={(event) => set_who(event.currentTarget.value)} />
    </label>
  );
}
