// Buses and jobs: what takes more than one request. A job is taken in or refused at once, and its end is told later.
//
//   queued ─► running ─► done, failed
//      └─────────┴─► cancelled by a person, expired by its time

import { signal } from "@preact/signals";
import { useEffect, useState } from "preact/hooks";
import { get, list, send } from "./api";
import { ago, clock, duration_us, when } from "./format";
import { job_news, tick } from "./live";
import { NameField } from "./name";
import type { Bus, Job } from "./types";
import { Act, complain, Danger, Dialog, None, say } from "./ui";
import { by } from "./who";

const buses = signal<Bus[]>([]);
const jobs = signal<Job[]>([]);
/** Jobs that are listed at most. */
const JOBS_MAX = 200;
/** Longest stretch that this page reads or writes at once. */
const STRETCH_MAX = 20_000;
const TABLES = ["coil", "discrete", "holding", "input"];

const over = (job: Job): boolean => job.state !== "queued" && job.state !== "running";

async function load(): Promise<void> {
  try {
    const [of_buses, of_jobs] = await Promise.all([
      list<Bus>("/v1/buses", "buses"),
      list<Job>("/v1/jobs", "jobs"),
    ]);
    buses.value = of_buses;
    jobs.value = of_jobs.reverse();
  } catch (error) {
    complain(error);
  }
}

async function begin(bus: Bus, what: object): Promise<void> {
  const job = await send<Job>("POST", "/v1/jobs", { bus: bus.name, host: bus.host, by: by(), ...what });
  say(`Job ${job.id} was taken in${job.ahead > 0 ? `, ${job.ahead} before it` : ""}.`);
  await load();
}

export function Jobs() {
  const [chosen, set_chosen] = useState("");
  useEffect(() => {
    void load();
    const every = setInterval(() => {
      if (!document.hidden) void load();
    }, 5_000);
    return () => clearInterval(every);
  }, []);
  useEffect(() => {
    if (job_news.value > 0) void load();
  }, [job_news.value]);
  tick.value;
  return (
    <>
      <NameOnce />
      <div class="cards hosts">
        {buses.value.map((bus) => (
          <BusCard key={`${bus.host} ${bus.name}`} bus={bus} />
        ))}
      </div>
      {buses.value.length === 0 && <None what="No buses." />}
      <section class="panel" aria-label="Jobs">
        <h2>Jobs</h2>
        {jobs.value.length === 0 ? (
          <None what="No jobs, and none that ended a while ago." />
        ) : (
          <div class="scroll" tabIndex={0} role="region" aria-label="Table of jobs">
            <table class="list stack">
              <thead>
                <tr>
                  <th>Job</th>
                  <th>What</th>
                  <th>State</th>
                  <th>By</th>
                  <th>Asked</th>
                  <th>
                    <span class="hidden">What to do</span>
                  </th>
                </tr>
              </thead>
              <tbody>
                {jobs.value.slice(0, JOBS_MAX).map((job) => (
                  <tr key={job.id}>
                    <th scope="row">{job.id}</th>
                    <td>
                      {job.task} <small>on {job.bus}</small>
                    </td>
                    <td>
                      <span class={job.state === "failed" || job.state === "expired" ? "tag warn" : "tag"}>{job.state}</span>
                      {job.state === "running" && ` step ${job.step} of ${job.steps}`}
                      {job.state === "queued" && job.ahead > 0 && ` ${job.ahead} before it`}
                      {job.reason && <small> {job.reason}</small>}
                      {job.state === "running" && <progress max={Math.max(1, job.steps)} value={Math.max(0, job.step - 1)} aria-label={`Steps of job ${job.id}`} />}
                    </td>
                    <td>{job.by}</td>
                    <td class="when">
                      {when(job.asked_unix_ms)} <small>{ago(job.asked_unix_ms)}</small>
                    </td>
                    <td class="acts">
                      {!over(job) && (
                        <Act
                          class="small"
                          label={`Cancel job ${job.id}`}
                          act={async () => {
                            await send("POST", `/v1/jobs/${encodeURIComponent(job.id)}/cancel`, { by: by() });
                            await load();
                            say(`Job ${job.id}: cancelled. What was done stays done.`);
                          }}
                        >
                          Cancel
                        </Act>
                      )}
                      <button type="button" class="small" aria-label={`Result of job ${job.id}`} onClick={() => set_chosen(job.id)}>
                        Result…
                      </button>
                    </td>
                  </tr>
                ))}
              </tbody>
            </table>
          </div>
        )}
      </section>
      {chosen && <Result key={chosen} id={chosen} close={() => set_chosen("")} />}
    </>
  );
}

function NameOnce() {
  return (
    <div class="narrow above">
      <NameField />
    </div>
  );
}

function BusCard({ bus }: { bus: Bus }) {
  const [open, set_open] = useState(false);
  const modbus = bus.driver.startsWith("modbus");
  return (
    <article class={`panel host${bus.connected ? "" : " grave"}`} aria-label={`Bus ${bus.name}`}>
      <header class="row">
        <h2 class="grow">
          {bus.name} <small>{bus.driver}</small>
        </h2>
        <span class={bus.connected ? "tag" : "tag urgent"}>{bus.connected ? "answers" : "does not answer"}</span>
      </header>
      <dl>
        <dt>Host</dt>
        <dd>
          {bus.host}
          {bus.redundant && (bus.redundant.epoch === null ? `, stands by for ${bus.redundant.with}` : `, master; ${bus.redundant.with} stands by`)}
        </dd>
        <dt>Points</dt>
        <dd>{bus.points}</dd>
        <dt>Requests</dt>
        <dd>
          {bus.polls} polls, {bus.writes} writes, {bus.errors} errors
        </dd>
        <dt>Last one took</dt>
        <dd>{duration_us(bus.latency_us)}</dd>
        {bus.last_error && (
          <>
            <dt>Last error</dt>
            <dd>{bus.last_error}</dd>
          </>
        )}
        <dt>Jobs</dt>
        <dd>{bus.jobs_waiting === 0 ? "none waits or runs" : `${bus.jobs_waiting} wait or run`}</dd>
      </dl>
      {bus.jobs.map((job) => (
        <Danger
          key={job.name}
          label={`Start ${job.name}`}
          title={`Start ${job.name} on ${bus.name}?`}
          text={`${job.text || "A job of the configuration."} What it has done when it fails or is cancelled stays done.`}
          name={job.name}
          act={() => begin(bus, { name: job.name })}
        />
      ))}
      {modbus && (
        <button type="button" class="small" aria-expanded={open} onClick={() => set_open(!open)}>
          Read or write registers…
        </button>
      )}
      {open && <Stretch bus={bus} />}
    </article>
  );
}

/** A stretch of neighbouring addresses, read or written. */
function Stretch({ bus }: { bus: Bus }) {
  const [table, set_table] = useState("holding");
  const [address, set_address] = useState("0");
  const [count, set_count] = useState("10");
  const [values, set_values] = useState("");
  const from = Number(address);
  const good = /^\d+$/.test(address) && from <= 65_535;
  const wanted = values.split(/[\s,;]+/).filter(Boolean).map(Number);
  const writable = table === "coil" || table === "holding";
  const good_values = wanted.length > 0 && wanted.length <= STRETCH_MAX && wanted.every((one) => Number.isInteger(one) && one >= 0 && one <= (table === "coil" ? 1 : 65_535));
  return (
    <fieldset>
      <legend>Neighbouring addresses, from 0</legend>
      <div class="grid4">
        <label class="field">
          <span>Table</span>
          <select value={table} onChange={(event) => set_table(event.currentTarget.value)}>
            {TABLES.map((name) => (
              <option key={name}>{name}</option>
            ))}
          </select>
        </label>
        <label class="field">
          <span>First address</span>
          <input inputMode="numeric" value={address} onInput={(event) => set_address(event.currentTarget.value)} />
        </label>
        <label class="field">
          <span>How many</span>
          <input inputMode="numeric" value={count} onInput={(event) => set_count(event.currentTarget.value)} />
        </label>
      </div>
      <Act class="small" off={!good || !(Number(count) >= 1 && Number(count) <= STRETCH_MAX)} act={() => begin(bus, { read_block: { table, address: from, count: Number(count) } })}>
        Read
      </Act>
      {writable && (
        <>
          <label class="field">
            <span>Values to write, {table === "coil" ? "0 or 1" : "0 to 65535"}, separated by commas</span>
            <input value={values} onInput={(event) => set_values(event.currentTarget.value)} />
          </label>
          <Danger
            label="Write"
            title={`Write ${wanted.length} values to ${bus.name}?`}
            text={`${table} ${from} to ${from + wanted.length - 1}, read back and compared. The device may act on them at once.`}
            name={bus.name}
            off={!good || !good_values}
            act={() => begin(bus, { write_block: { table, address: from, values: wanted } })}
          />
        </>
      )}
    </fieldset>
  );
}

/** The second of a job's two replies. */
function Result({ id, close }: { id: string; close: () => void }) {
  const [job, set_job] = useState<Job | null>(null);
  useEffect(() => {
    get<Job>(`/v1/jobs/${encodeURIComponent(id)}`).then(set_job, complain);
  }, [id, job_news.value]);
  return (
    <Dialog title={`Job ${id}`} close={close}>
      {job === null ? (
        <p>Reading…</p>
      ) : (
        <>
          <dl>
            <dt>What</dt>
            <dd>
              {job.task} on {job.bus} at {job.host}
            </dd>
            <dt>State</dt>
            <dd>
              {job.state}
              {job.reason && `: ${job.reason}`}
            </dd>
            <dt>Asked</dt>
            <dd>
              {when(job.asked_unix_ms)} by {job.by}
            </dd>
            {job.began_unix_ms !== null && (
              <>
                <dt>Ran</dt>
                <dd>
                  {clock(job.began_unix_ms)}
                  {job.ended_unix_ms !== null && ` to ${clock(job.ended_unix_ms)}, ${duration_us((job.ended_unix_ms - job.began_unix_ms) * 1_000)}`}
                </dd>
              </>
            )}
          </dl>
          {job.result.length === 0 ? (
            <None what="It read nothing." />
          ) : (
            job.result.map((block) => (
              <div key={`${block.unit_id} ${block.table} ${block.address}`}>
                <h3>
                  unit {block.unit_id}, {block.table} {block.address} to {block.address + Math.max(1, block.count) - 1}
                </h3>
                <p class="digest">{block.values.length > 0 ? block.values.join(", ") : "answers"}</p>
              </div>
            ))
          )}
        </>
      )}
    </Dialog>
  );
}
