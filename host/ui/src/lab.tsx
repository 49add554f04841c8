// Reports of the lab, as far as the host that serves this page has them. A report is shown in a frame that may draw and nothing else.

import { useEffect, useState } from "preact/hooks";
import { get } from "./api";
import { bytes, when, zone } from "./format";
import { here } from "./live";
import { complain, None } from "./ui";

interface Report {
  name: string;
  files: string[];
  bytes: number;
  written_unix_ms: number;
}
interface Reports {
  has_folder: boolean;
  reports: Report[];
  left_off: number;
}

const address = (file: string): string => `/v1/lab/reports/${encodeURIComponent(file)}`;

export function Lab(props: { name: string }) {
  const [list, set_list] = useState<Reports | null>(null);
  const [filter, set_filter] = useState("");
  useEffect(() => {
    const read = (): void => void get<Reports>("/v1/lab/reports").then(set_list, complain);
    read();
    const every = setInterval(read, 15_000);
    return () => clearInterval(every);
  }, []);
  const report = list?.reports.find((one) => one.name === props.name);
  if (props.name && report) return <One report={report} />;
  const shown = (list?.reports ?? []).filter((one) => one.name.toLowerCase().includes(filter.trim().toLowerCase()));
  return (
    <>
      <div class="head">
        <h1>Lab</h1>
        <p class="quiet">
          reports at {here.value}, times in {zone()}
        </p>
        {list?.has_folder && (
          <div class="row end grow">
            <input type="search" class="short" placeholder="filter" aria-label="Filter reports" value={filter} onInput={(event) => set_filter(event.currentTarget.value)} />
          </div>
        )}
      </div>
      {props.name && list && <p class="warn-text">There is no report {props.name} (any more).</p>}
      {list && !list.has_folder && (
        <section class="panel narrow">
          <p>This host has no folder of reports. Name one in its configuration, and run the lab into it:</p>
          <pre class="code-block">{'[lab]\nreports = "lab-out"'}</pre>
          <pre class="code-block">bumpless lab run flow.toml --out lab-out</pre>
        </section>
      )}
      {list?.has_folder && shown.length === 0 && <None what="No reports yet: bumpless lab run EXPERIMENT --out the folder that [lab] reports names." />}
      <div class="cards hosts">
        {shown.map((one) => (
          <article key={one.name} class="panel" aria-label={`Report ${one.name}`}>
            <h2>
              <a href={`#/lab/${encodeURIComponent(one.name)}`}>{one.name}</a>
            </h2>
            <p class="quiet">
              {when(one.written_unix_ms)}, {bytes(one.bytes)}
            </p>
            <Files report={one} />
          </article>
        ))}
      </div>
      {list && list.left_off > 0 && <p class="hint">{list.left_off} older ones are left out.</p>}
    </>
  );
}

function Files({ report }: { report: Report }) {
  return (
    <p class="row wrap">
      {report.files.map((file) => (
        <a key={file} class="small-link" href={address(file)} target="_blank" rel="noreferrer" download={file.endsWith(".html") ? undefined : file}>
          {file}
        </a>
      ))}
    </p>
  );
}

function One({ report }: { report: Report }) {
  return (
    <>
      <div class="head">
        <a class="back" href="#/lab" aria-label="Back to all reports">
          ←
        </a>
        <h1>{report.name}</h1>
        <p class="quiet">
          {when(report.written_unix_ms)}, {bytes(report.bytes)}
        </p>
        <div class="row end grow">
          <Files report={report} />
        </div>
      </div>
      <iframe key={`${report.name} ${report.written_unix_ms}`} class="report" title={`Report ${report.name}`} src={address(`${report.name}.html`)} sandbox="" referrerpolicy="no-referrer" />
    </>
  );
}
