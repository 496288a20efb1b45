// The rerun viewer: loaded only when somebody asks for the 3D view, fed with recording segments as they come.
//
// The viewer is WebAssembly with the JavaScript that wasm-bindgen made for it. Both come from our own server, at
// the version of the SDK that wrote the recording.

import { getLarge } from "./api.ts";

/** Hears how much of the viewer has been loaded. */
export type LoadingListener = (loadedBytes: number, totalBytes: number | null) => void;

/** A running viewer. */
export interface Viewer {
  /** Shows one more segment: a complete small RRD file. */
  send(segment: Uint8Array): void;
  /** Why it stopped working, or null while it works. */
  failure(): string | null;
  /** Ends it and gives the memory back. */
  close(): void;
}

interface WebHandle {
  start(canvas: HTMLCanvasElement): Promise<void>;
  open_channel(id: string, name: string): void;
  send_rrd_to_channel(id: string, bytes: Uint8Array): void;
  close_channel(id: string): void;
  has_panicked(): boolean;
  panic_message(): string | undefined;
  destroy(): void;
  free(): void;
}

/** What the viewer's script defines for the whole page; not a property of `window`. */
declare const wasm_bindgen: {
  (source: { module_or_path: Response }): Promise<unknown>;
  WebHandle: new (options: object) => WebHandle;
};

/** A WebAssembly module with one SIMD instruction: the viewer needs SIMD, old browsers lack it. */
const SIMD_PROBE = new Uint8Array([
  0, 97, 115, 109, 1, 0, 0, 0, 1, 5, 1, 96, 0, 1, 123, 3, 2, 1, 0, 10, 10, 1, 8, 0, 65, 0, 253, 15, 253, 98, 11,
]);

/** Set when the page is built. */
declare const VIEWER_FOLDER: string;

const CHANNEL = "stria";

/** Where the server keeps the viewer's two files, at the version of its own SDK. */
const FOLDER = VIEWER_FOLDER;

let loaded: Promise<void> | undefined;

/** True where this browser can run the viewer. */
export function viewerRuns(): boolean {
  return typeof WebAssembly === "object" && WebAssembly.validate(SIMD_PROBE);
}

/**
 * Starts the viewer on a canvas, loading it first where this page has not done so yet. `name` is what the viewer
 * calls the source of the data.
 */
export async function startViewer(
  canvas: HTMLCanvasElement,
  name: string,
  progress: LoadingListener,
): Promise<Viewer> {
  loaded ??= load(progress).catch((error: unknown) => {
    loaded = undefined; // the next click tries again
    throw error;
  });
  await loaded;
  const handle = new wasm_bindgen.WebHandle({
    render_backend: "webgl",
    hide_welcome_screen: true,
    persist: false,
    enable_history: false,
    notebook: false,
    theme: "system",
    panel_state_overrides: { top: "Hidden", blueprint: "Hidden", selection: "Hidden", time: "Collapsed" },
  });
  await handle.start(canvas);
  handle.open_channel(CHANNEL, name);
  return {
    send: (segment) => handle.send_rrd_to_channel(CHANNEL, segment),
    failure: () => (handle.has_panicked() ? (handle.panic_message() ?? "no reason given") : null),
    close: () => {
      handle.close_channel(CHANNEL);
      handle.destroy();
      handle.free();
    },
  };
}

async function load(progress: LoadingListener): Promise<void> {
  keepRequestsHome();
  await loadScript(`${FOLDER}/re_viewer.js`);
  await wasm_bindgen({ module_or_path: await getLarge(`${FOLDER}/re_viewer_bg.wasm`, progress) });
}

function loadScript(address: string): Promise<void> {
  return new Promise((done, failed) => {
    const script = document.createElement("script");
    script.src = address;
    script.onload = () => done();
    script.onerror = () => {
      script.remove();
      failed(new Error(`${address} could not be loaded`));
    };
    document.head.append(script);
  });
}

/**
 * The viewer reports its use to its makers. The content security policy forbids that already; this answers such a
 * request inside the page, so that nothing is even tried and no error fills the console.
 */
function keepRequestsHome(): void {
  const fetchAnywhere = window.fetch.bind(window);
  window.fetch = (input, init) => {
    const address = new URL(input instanceof Request ? input.url : input, location.href);
    const ours = address.origin === location.origin || address.protocol === "blob:";
    return ours ? fetchAnywhere(input, init) : Promise.resolve(new Response(null, { status: 204 }));
  };
}
