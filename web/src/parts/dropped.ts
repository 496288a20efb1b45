// Files that are dragged over the page and let go on it.

import { useEffect, useRef, useState } from "preact/hooks";

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
