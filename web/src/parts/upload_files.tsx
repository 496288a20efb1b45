// Files for an upload: dropped anywhere on the page or chosen with a button, and the list of what was chosen.

import { useEffect, useRef, useState } from "preact/hooks";
import { size } from "../format.ts";
import { texts } from "../texts.ts";

/** True while files hover over the page; `take` gets them when they are let go. Null takes nothing. */
export function useDroppedFiles(take: ((files: File[]) => void) | null): boolean {
  const [dragging, setDragging] = useState(false);
  const newest = useRef(take);
  newest.current = take;
  useEffect(() => {
    // The whole page takes the drop: a file let go beside the field must not replace the page.
    const over = (event: DragEvent) => {
      if (!event.dataTransfer?.types.includes("Files")) return;
      event.preventDefault();
      setDragging(newest.current !== null);
    };
    const left = (event: DragEvent) => {
      if (event.relatedTarget === null) setDragging(false);
    };
    const dropped = (event: DragEvent) => {
      if (!event.dataTransfer?.types.includes("Files")) return;
      event.preventDefault();
      setDragging(false);
      newest.current?.([...event.dataTransfer.files]);
    };
    addEventListener("dragover", over);
    addEventListener("dragleave", left);
    addEventListener("drop", dropped);
    return () => {
      removeEventListener("dragover", over);
      removeEventListener("dragleave", left);
      removeEventListener("drop", dropped);
    };
  }, []);
  return dragging;
}

/** The place to drop files on, with a button for those who rather choose them. */
export function DropPlace({ dragging, onFiles }: { dragging: boolean; onFiles: (files: File[]) => void }) {
  return (
    <div class="drop">
      <p class="drop-words">{dragging ? texts.upload.dropNow : texts.upload.drop}</p>
      <label class="button">
        {texts.upload.choose}
        <input
          type="file"
          multiple
          class="unseen"
          onChange={(event) => {
            onFiles([...(event.currentTarget.files ?? [])]);
            event.currentTarget.value = ""; // the same file may be chosen again after it was removed
          }}
        />
      </label>
      <p class="faint">{texts.upload.hint}</p>
    </div>
  );
}

export function ChosenFiles({ files, onRemove }: { files: File[]; onRemove: (file: File) => void }) {
  return (
    <ul class="chosen" aria-label={texts.upload.chosen}>
      {files.map((file, index) => (
        <li key={`${index} ${file.name}`}>
          <span class="words">{file.name}</span> <span class="faint">{size(file.size)}</span>
          <button type="button" class="quiet" aria-label={texts.upload.remove(file.name)} onClick={() => onRemove(file)}>
            ✕
          </button>
        </li>
      ))}
    </ul>
  );
}
