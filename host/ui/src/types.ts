// What travels between page and host, as far as the page reads it. docs/openapi.json is the whole of it.
// Times are µs or ms since 1970-01-01 UTC; a number that is not finite is null.

export type Mode = "manual" | "automatic";
export type Quality = "bad" | "uncertain" | "good";
export type Weight = "info" | "warning" | "urgent";

export interface Row {
  loop: string;
  term: number;
  seq: number;
  revision: number;
  at_unix_us: number;
  mode: Mode;
  setpoint: number | null;
  measurement: number | null;
  quality: Quality;
  outputs: Record<string, number | null>;
  owner: string;
  stepped_by: string;
  step_us: number;
  committed_after_us: number;
  faults_in_row: number;
  probation_cycles_left: number | null;
}

export interface Rows {
  lost: number;
  loops: Row[];
  trace: Row[];
}

export interface Standing {
  loop: string;
  revision: number;
  pending_revision: number | null;
  members: string[];
  failures: number;
  lost: number | null;
  takeovers: number | null;
}

export interface Notice {
  number: number;
  at_unix_us: number;
  loop: string;
  term: number;
  seq: number;
  weight: Weight;
  kind: string;
  text: string;
}

export interface Host {
  name: string;
  here: boolean;
  alive: boolean;
  io: boolean;
  control: boolean;
  draining: boolean;
  api: string | null;
  cpu_percent: number;
  cpu_process_cores: number;
  memory_bytes: number;
  latency_ms: number | null;
  loops_owned: number;
  loops_held: number;
  version: string;
}

export interface OutputLimit {
  low: number;
  high: number;
  rate_per_s?: number | null;
  safe: number;
}

export interface Policy {
  bump_limit_percent: number;
  probation_cycles: number;
  [key: string]: unknown;
}

export interface LoopDraft {
  name: string;
  component: string;
  period_ms: number;
  ports: Record<string, string>;
  parameters: Record<string, number>;
  setpoint: number;
  setpoint_range?: [number, number] | null;
  mode: Mode;
  strategy: string;
  replicas: number;
  limits: Record<string, OutputLimit>;
  policy: Policy;
  [key: string]: unknown;
}

export interface Loop {
  name: string;
  home: string;
  component: string;
  digest: string;
  revision: number;
  pending_revision: number | null;
  past_revisions: number[];
  spec: LoopDraft;
  members: string[];
  measured_port: string | null;
  measured_unit: string | null;
  tally: { taken: number; lost: number; skipped: number; takeovers: number; refused: number } | null;
  failures: { revision: number; reason: string; tries: number }[];
}

export interface Point {
  name: string;
  host: string;
  bus: string;
  unit: string;
  range: [number, number];
  writable: boolean;
  value: number | null;
  quality: Quality;
  reason: string;
  age_ms: number;
  written_by: string | null;
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

export interface Port {
  name: string;
  direction: "input" | "output";
  unit: string;
  required: boolean;
  text: string;
}

export interface Admission {
  verdict: string;
  checked_at_unix_ms: number;
  host: string;
  cycles: number;
  steps: number;
  step_p50_us: number;
  step_p99_us: number;
  step_worst_us: number;
  start_us: number;
  migrated: string;
  migrate_us: number;
  state_bytes: number;
  memory_bytes: number;
  compile_ms: number | null;
  findings: { severity: string; text: string }[];
}

export interface Component {
  digest: string;
  name: string;
  version: string;
  text: string;
  ports: Port[];
  parameters: Parameter[];
  imports: string[];
  size_bytes: number;
  uploaded_at_unix_ms: number;
  uploaded_by: string;
  note: string;
  labels: Record<string, string>;
  history: { at_unix_ms: number; by: string; what: string }[];
  admission: Admission | null;
  used_by: string[];
  ready_on: string[];
  hosts?: { host: string; stage: string; reason: string }[] | null;
}

export interface Trend {
  loop: string;
  cycles: number;
  read_to_unix_us: number;
  unread: number;
  hosts: string[];
  at_unix_us: number[];
  seq: number[];
  setpoint: (number | null)[];
  measurement: (number | null)[];
  good: boolean[];
  outputs: Record<string, (number | null)[]>;
  automatic: boolean[];
  owner: number[];
  stepped_by: number[];
  step_us: number[];
  committed_after_us: number[];
  notices: Notice[];
}

export interface HistoryValues {
  min: (number | null)[];
  max: (number | null)[];
  mean: (number | null)[];
}

export interface History {
  from_unix_us: number;
  to_unix_us: number;
  piece_ms: number;
  gaps: { from_unix_us: number; to_unix_us: number }[];
  at_unix_us: number[];
  ms: number[];
  cycles: number[];
  lost: number[];
  bad: number[];
  manual: number[];
  setpoint: HistoryValues;
  measurement: HistoryValues;
  outputs: Record<string, HistoryValues>;
  step_us: HistoryValues;
}

export interface Trial {
  component: string;
  digest: string;
  verdict: "same" | "close" | "differs" | "fails" | null;
  reason: string;
  taken_over_by: string | null;
  cycles: number;
  compared: number;
  equal: number;
  held: number;
  faults: number;
  first_fault: { term: number; seq: number; text: string } | null;
  dropped_parameters: string[];
  dropped_ports: string[];
  bump_percent: number | null;
  bump_limit_percent: number;
  outputs: { port: string; unit: string; max_percent: number | null; rms_percent: number | null; mean_percent: number | null }[];
  steps: { p50_us: number; p99_us: number; worst_us: number };
  indices: { duration_s: number; iae: number | null };
  measured_unit: string;
  points: {
    at_unix_us: number;
    setpoint: number | null;
    measurement: number | null;
    recorded: (number | null)[];
    candidate: (number | null)[];
  }[];
  stopped_early: string | null;
}

export interface Shadow {
  id: number;
  cycles_wanted: number;
  missed: number;
  started_at_unix_ms: number;
  ended: string | null;
  complete: boolean;
  report: Trial;
}

export interface Apply {
  loop: string;
  revision: number;
  created: boolean;
  unchanged: boolean;
  hand_over: { by: string; bump_percent: number | null; from_digest: string } | null;
  dropped_parameters: string[];
  dropped_ports: string[];
  warnings: string[];
}

export interface Rollout {
  id: string;
  host: string;
  component: string;
  cycles: number;
  factor: number;
  at_once: number;
  on_failure: string;
  state: "running" | "done" | "failed" | "stopped";
  failure: string | null;
  started_at_unix_ms: number;
  ended_at_unix_ms: number | null;
  total: number;
  done: number;
  loops: { loop: string; stage: string; reason: string; cycles_before: number; cycles: number; error_before: number | null; error: number | null }[];
}
