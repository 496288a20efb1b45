// Files for an upload: the place to drop or choose them, and the list of what was chosen.

import { size } from "../format.ts";
import { uploadTexts } from "../texts/upload.ts";

/** The place to drop files on, with a button for those who rather choose them. */
export function DropPlace({ onFiles }: { onFiles: (files: File[]) => void }) {
  return (
    <div class="drop">
      <p class="drop-words">{uploadTexts.drop}</p>
      <label class="button">
        {uploadTexts.choose}
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
      <p class="faint">{uploadTexts.hint}</p>
    </div>
  );
}

export function ChosenFiles({ files, onRemove }: { files: File[]; onRemove: (file: File) => void }) {
  return (
    <ul class="chosen" aria-label={uploadTexts.chosen}>
      {files.map((file, index) => (
        <li key={`${index} ${file.name}`}>
          <span class="words">{file.name}</span> <span class="faint">{size(file.size)}</span>
          <button type="button" class="quiet" aria-label={uploadTexts.remove(file.name)} onClick={() => onRemove(file)}>
            ✕
          </button>
        </li>
      ))}
    </ul>
  );
}
