// What travels between page and host, as far as the page reads it. docs/openapi.json is the whole of it.
// Times are µs or ms since 1970-01-01 UTC; a number that is not finite is null.

export type Mode = "manual" | "automatic";
export type Quality = "bad" | "uncertain" | "good" | "forced";
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
  drain_kept: boolean;
  labels: string[];
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

/** How a vote stands. */
export interface Vote {
  answers: number;
  agreed: number;
  needed: number;
  dissents: number;
  aside: { host: string; clean: number }[];
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
  fallback?: string | null;
  fallback_parameters?: Record<string, number>;
  prefer?: string[];
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
  redundancy?: { have: number; want: number; vote: Vote | null } | null;
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
  force: Force | null;
}

/** Who holds a point at a value, and until when. */
export interface Force {
  value: number | null;
  since_unix_ms: number;
  until_unix_ms: number;
  by: string;
  why: string;
}

export interface Bus {
  name: string;
  host: string;
  driver: string;
  connected: boolean;
  points: number;
  polls: number;
  writes: number;
  errors: number;
  last_error: string | null;
  latency_us: number;
  jobs: { name: string; text: string }[];
  jobs_waiting: number;
  redundant: { with: string; epoch: number | null } | null;
}

export type JobState = "queued" | "running" | "done" | "failed" | "cancelled" | "expired";

export interface Block {
  unit_id: number;
  table: string;
  address: number;
  count: number;
  values: number[];
}

export interface Job {
  id: string;
  host: string;
  bus: string;
  task: string;
  by: string;
  state: JobState;
  ahead: number;
  step: number;
  steps: number;
  reason: string;
  result: Block[];
  asked_unix_ms: number;
  began_unix_ms: number | null;
  ended_unix_ms: number | null;
}

/** One of these is there. */
export interface FieldNews {
  job?: Job;
  forced?: { point: string; host: string; force: Force };
  unforced?: { point: string; host: string; by: string };
  written?: { point: string; host: string; value: number | null; by: string };
}

export type Priority = "low" | "medium" | "high";
export type AlarmState = "normal" | "active" | "acknowledged" | "returned" | "latched";

/** An alarm as it was decided upon. */
export interface AlarmDefinition {
  kind: string;
  port?: string | null;
  limit?: number | null;
  dead_band: number;
  on_delay_s: number;
  off_delay_s: number;
  priority: Priority;
  latching: boolean;
  group?: string | null;
  suppressed_by?: string | null;
  cause: string;
  consequence: string;
  response: string;
}

export interface Alarm {
  loop: string;
  name: string;
  host: string;
  state: AlarmState;
  priority: Priority;
  age_s: number | null;
  value: number | null;
  text: string;
  comings: number;
  first_out: boolean;
  acknowledged_by: string | null;
  note: string | null;
  quiet: boolean;
  shelf: { seconds_left: number; by: string; reason: string } | null;
  suppressed: boolean;
  out_of_service: string | null;
  definition: AlarmDefinition;
}

export interface Flood {
  host: string;
  comings: number;
  is_flood: boolean;
}

export interface AlarmList {
  alarms: Alarm[];
  floods: Flood[];
  silent: { host: string; reason: string }[];
  next?: string | null;
}

export interface AlarmChange {
  at_unix_us: number;
  loop: string;
  alarm: string;
  what: string;
  state: AlarmState;
  priority: Priority;
  value: number | null;
  by: string | null;
  note: string;
  quiet: boolean;
  first_out: boolean;
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

/** An entry of the audit trail with its place in its host's chain. */
export interface AuditLine {
  host: string;
  number: number;
  prev: string;
  hash: string;
  at: string;
  what: string;
  by: string;
  via: string;
  from: string;
  loop: string | null;
  target: string;
  asked: unknown;
  changes: { field: string; before: unknown; after: unknown }[];
  outcome: string;
  reason: string;
  took_ms: number;
}

export interface AuditList {
  entries: AuditLine[];
  next: string | null;
  silent?: { host: string; reason: string }[];
}

export interface AuditProof {
  good: boolean;
  chains: { host: string; good: boolean; first: number; last: number; flaw: { segment: string; line: number; reason: string } | null }[];
  silent: { host: string; reason: string }[];
}
