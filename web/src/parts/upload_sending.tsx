// Sending runs one after the other: how far it is, and how each of them ended.

import { useEffect, useRef, useState } from "preact/hooks";
import { problemOf, sendRun, type Problem, type Upload } from "../api.ts";
import { Link, runPath } from "../router.tsx";
import { texts } from "../texts.ts";
import { ProblemBox } from "./problem.tsx";

type Sending = { name: string; number: number; all: number; sent: number; bytes: number; sinceMs: number };

/** How the sending of one video ended. */
export type Outcome = { video: File } & ({ run: string } | { problem: Problem } | { stopped: true });

export interface Sender {
  /** What is on its way, or null. */
  sending: Sending | null;
  /** Sends all, in order; answers how each of them ended. One that is refused does not keep back the next. */
  send: (uploads: Upload[]) => Promise<Outcome[]>;
  stop: () => void;
}

export function useSender(): Sender {
  const [sending, setSending] = useState<Sending | null>(null);
  const stopper = useRef<AbortController | null>(null);
  const send = async (uploads: Upload[]) => {
    const { signal } = (stopper.current = new AbortController());
    const outcomes: Outcome[] = [];
    for (const [index, upload] of uploads.entries()) {
      const { video } = upload;
      const start = { name: video.name, number: index + 1, all: uploads.length, sent: 0, bytes: video.size, sinceMs: performance.now() };
      setSending(start);
      try {
        const run = await sendRun(upload, (sent, bytes) => setSending({ ...start, sent, bytes }), signal);
        outcomes.push({ video, run: run.id });
      } catch (error) {
        outcomes.push(signal.aborted ? { video, stopped: true } : { video, problem: problemOf(error) });
      }
      if (signal.aborted) break;
    }
    setSending(null);
    return outcomes;
  };
  return { sending, send, stop: () => stopper.current?.abort() };
}

/** Shorter than this, the rate of an upload says nothing yet. */
const RATE_AFTER_S = 0.2;

export function SendingProgress({ sending, onStop }: { sending: Sending; onStop: () => void }) {
  const stopButton = useRef<HTMLButtonElement>(null);
  // The form that was sent is gone: the keyboard goes on, and the page moves, to where the sending can be watched.
  useEffect(() => stopButton.current?.focus(), []);
  const seconds = (performance.now() - sending.sinceMs) / 1000;
  const bytesPerS = seconds > RATE_AFTER_S ? sending.sent / seconds : 0;
  const arrived = sending.sent >= sending.bytes;
  const leftS = bytesPerS > 0 && !arrived ? (sending.bytes - sending.sent) / bytesPerS : null;
  const what = texts.upload.sending(sending.name, sending.number, sending.all);
  return (
    <div class="sending">
      <p role="status" class="words">
        {arrived ? texts.upload.arrived : what}
      </p>
      <progress max={sending.bytes} value={sending.sent} aria-label={what} />
      <p class="faint">{texts.upload.progress(sending.sent, sending.bytes, bytesPerS, leftS)}</p>
      <p class="actions">
        <button type="button" ref={stopButton} onClick={onStop}>
          {texts.upload.cancel}
        </button>
      </p>
    </div>
  );
}

export function OutcomeLine({ outcome }: { outcome: Outcome }) {
  const { name } = outcome.video;
  if ("problem" in outcome) {
    return (
      <ProblemBox problem={outcome.problem} heading={texts.upload.refused(name)}>
        {outcome.problem.detail === "" && <p>{texts.problem.uploadCut}</p>}
      </ProblemBox>
    );
  }
  return (
    <p class="notice good words" role="status">
      {"run" in outcome ? (
        <>
          {texts.upload.sent(name)} <Link to={runPath(outcome.run)}>{texts.upload.show}</Link>
        </>
      ) : (
        texts.upload.stopped(name)
      )}
    </p>
  );
}
