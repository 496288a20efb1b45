// Files on their way: how far each is, and what can be done about it.

import { Link, runPath } from "../router.tsx";
import { uploadTexts } from "../texts/upload.ts";
import { clearSent, discard, pause, resume, type Item } from "../uploads.ts";
import { ProblemBox } from "./problem.tsx";

const words = uploadTexts;

export function UploadList({ items }: { items: Item[] }) {
  if (items.length === 0) return null;
  return (
    <section class="card" aria-label={words.list}>
      <div class="panel-head">
        <h2>{words.list}</h2>
        {items.some(({ state }) => state === "sent") && (
          <button type="button" class="quiet small" onClick={clearSent}>
            {words.clearSent}
          </button>
        )}
      </div>
      <ul class="uploads">
        {items.map((item) => (
          <Row key={item.id} item={item} />
        ))}
      </ul>
    </section>
  );
}

function Row({ item }: { item: Item }) {
  const { id, name, state, sent, bytes, bytes_per_s } = item;
  const moving = state === "sending" && bytes_per_s > 0;
  const facts = [
    words.progress(sent, bytes),
    ...(moving ? [words.rate(bytes_per_s), words.left((bytes - sent) / bytes_per_s)] : []),
  ];
  return (
    <li class={`upload-item ${state}`} data-state={state}>
      <div class="upload-words">
        <strong class="words">{name}</strong> <span class="faint words">{item.asset}</span>
        <p class={state === "cut" || state === "lost" ? "warn-words" : "faint"} role="status">
          {words.states[state]}
        </p>
      </div>
      {state !== "sent" && state !== "refused" && (
        <div class="upload-bar">
          <progress max={Math.max(bytes, 1)} value={sent} aria-label={words.bar(name)} />
          <span class="faint">{facts.join(" · ")}</span>
        </div>
      )}
      <p class="actions">
        {(state === "sending" || state === "waiting" || state === "cut") && (
          <button type="button" class="small" aria-label={`${words.pause}: ${name}`} onClick={() => pause(id)}>
            {words.pause}
          </button>
        )}
        {state === "paused" && (
          <button type="button" class="small" aria-label={`${words.resume}: ${name}`} onClick={() => resume(id)}>
            {words.resume}
          </button>
        )}
        {state === "refused" && (
          <button type="button" class="small" aria-label={`${words.again}: ${name}`} onClick={() => resume(id)}>
            {words.again}
          </button>
        )}
        {state === "sent" && item.run !== null && <Link to={runPath(item.run)}>{words.show}</Link>}
        <button type="button" class="quiet small" aria-label={`${state === "sent" ? words.forget : words.discard}: ${name}`} onClick={() => void discard(id)}>
          {state === "sent" ? words.forget : words.discard}
        </button>
      </p>
      {item.problem && <ProblemBox problem={item.problem} />}
    </li>
  );
}

