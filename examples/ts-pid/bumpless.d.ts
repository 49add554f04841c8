// The types of wit/control.wit as TypeScript sees them: names in camel case, enums and variants as words, u64 as numbers.
// A top-level result is returned, and its error thrown. First the nouns, which exist for the compiler alone; then the
// interfaces that a law may import.

declare module "bumpless:types" {
  export type Fault = { tag: "bad-parameter" | "bad-state" | "bad-input" | "failed"; val: string };
  export type Quality = "good" | "uncertain" | "bad";
  export type Mode = "manual" | "automatic";

  export interface Port {
    name: string;
    direction: "input" | "output";
    kind: "analog" | "digital";
    unit: string;
    required: boolean;
    text: string;
  }

  export interface Parameter {
    name: string;
    unit: string;
    default: number;
    minimum: number;
    maximum: number;
    choices: string[];
    text: string;
  }

  export interface Descriptor {
    name: string;
    version: string;
    text: string;
    ports: Port[];
    parameters: Parameter[];
    stateLayout: number;
  }

  export interface Origin {
    name: string;
    version: string;
    stateLayout: number;
  }

  export interface Cycle {
    sequence: number;
    timeNs: number;
    dtNs: number;
    mode: Mode;
    setpoint: number;
    connected: number;
  }

  export interface Reading {
    value: number;
    quality: Quality;
    ageNs: number;
    fresh: boolean;
  }

  export interface Message {
    topic: string;
    data: Uint8Array;
  }

  /** What a law exports under the name `control`. */
  export interface Control {
    describe(): Descriptor;
    start(parameters: number[], track: number[]): Uint8Array;
    step(cycle: Cycle, state: Uint8Array): Uint8Array;
    migrate(from: Origin, state: Uint8Array, parameters: number[], track: number[]): Uint8Array;
  }
}

declare module "bumpless:control/io@0.1.0" {
  import type { Reading } from "bumpless:types";
  const io: {
    count(): number;
    find(name: string): number | null;
    read(port: number): Reading;
    write(port: number, value: number): void;
  };
  export default io;
}

declare module "bumpless:control/timer@0.1.0" {
  const timer: { nowNs(): number; sinceLastStepNs(): number };
  export default timer;
}

declare module "bumpless:control/net@0.1.0" {
  import type { Message } from "bumpless:types";
  const net: { publish(topic: string, data: Uint8Array): void; receive(): Message | null };
  export default net;
}

declare module "bumpless:control/alarm@0.1.0" {
  const alarm: {
    raise(name: string, priority: "low" | "medium" | "high", text: string): void;
    clear(name: string): void;
  };
  export default alarm;
}

declare module "bumpless:control/log@0.1.0" {
  const log: { write(level: "debug" | "info" | "warning", text: string): void };
  export default log;
}
