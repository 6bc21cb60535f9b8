import { trimmed } from "../../math/units";
import type { Seen } from "../../state/processes";

// Processes report once a second; so many misses are no accident.
const SILENT_MS = 5000;

export function ProcessCard({ seen }: { readonly seen: Seen }) {
  const { report, arrivedMs } = seen;
  const isSilent = performance.now() - arrivedMs > SILENT_MS;
  const rates = Object.entries(report.rates);
  const drops = Object.entries(report.drops).filter(([, count]) => count > 0);
  return (
    <article class="card process" aria-label={report.name} tabIndex={0}>
      <header class="spread">
        <h3>{report.name}</h3>
        <span class={`badge ${isSilent ? "bad" : report.state}`}>{isSilent ? "silent" : report.state}</span>
      </header>
      {report.detail && <p class="quiet small">{report.detail}</p>}
      <dl>
        {rates.map(([name, rate]) => (
          <Row key={name} name={name} value={`${trimmed(rate, 1)}/s`} />
        ))}
        {drops.map(([name, count]) => (
          <Row key={name} name={`lost: ${name}`} value={String(count)} />
        ))}
        <Row
          name="clock within"
          value={report.clock_bound_ms == null ? "not compared" : `${trimmed(report.clock_bound_ms, 2)} ms`}
        />
      </dl>
    </article>
  );
}

function Row({ name, value }: { readonly name: string; readonly value: string }) {
  return (
    <div class="spread">
      <dt class="cut">{name.replaceAll("_", " ")}</dt>
      <dd>{value}</dd>
    </div>
  );
}
