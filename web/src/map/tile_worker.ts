// Beside the page: fetches tiles, reads their depths, paints them. The page itself only moves finished pictures.

import { getTile } from "../api_tiles.ts";
import { paint, type Style } from "./colours.ts";
import { depthsOf } from "./depths.ts";

/** What the page asks for. */
export type Order =
  | { is: "depth"; id: number; url: string; step_mm: number; offset_mm: number; mm_per_px: number; style: Style; fresh: boolean }
  | { is: "texture"; id: number; url: string; fresh: boolean; depth_mm: Float32Array | null }
  | { is: "paint"; id: number; depth_mm: Float32Array; side: number; mm_per_px: number; style: Style }
  | { is: "stop"; id: number };

/** What it gets. `depth_mm` is there for a depth tile that was fetched. */
export type Delivery =
  | { id: number; is: "done"; picture: ImageBitmap; depth_mm: Float32Array | null }
  | { id: number; is: "missing" }
  | { id: number; is: "failed" };

const stoppers = new Map<number, AbortController>();

/** Gray that stands where no image fell, and how far the picture's compression may take it. */
const NO_IMAGE = 128;
const NEAR_NO_IMAGE = 6;

/** The visible image, clear where there is none: the file cannot say so, its flat gray without a depth does. */
async function textureOf(bytes: Blob, depth_mm: Float32Array | null): Promise<ImageBitmap> {
  const image = await createImageBitmap(bytes);
  if (depth_mm === null || depth_mm.length !== image.width * image.height) return image;
  const context = new OffscreenCanvas(image.width, image.height).getContext("2d", { willReadFrequently: true });
  if (context === null) return image;
  context.drawImage(image, 0, 0);
  image.close();
  const pixels = context.getImageData(0, 0, context.canvas.width, context.canvas.height);
  const { data } = pixels;
  const gray = (at: number) => Math.abs(data[at]! - NO_IMAGE) <= NEAR_NO_IMAGE;
  for (let at = 0; at < depth_mm.length; at += 1) {
    if (depth_mm[at] !== depth_mm[at] && gray(4 * at) && gray(4 * at + 1) && gray(4 * at + 2)) data[4 * at + 3] = 0;
  }
  return createImageBitmap(pixels);
}

async function follow(order: Exclude<Order, { is: "stop" }>): Promise<Delivery> {
  const { id } = order;
  if (order.is === "paint") {
    const painted = paint(order.depth_mm, order.side, order.mm_per_px, order.style);
    return { id, is: "done", picture: await createImageBitmap(painted), depth_mm: null };
  }
  const stopper = new AbortController();
  stoppers.set(id, stopper);
  try {
    const bytes = await getTile(order.url, order.fresh, stopper.signal);
    if (bytes === null) return { id, is: "missing" };
    if (order.is === "texture") return { id, is: "done", picture: await textureOf(bytes, order.depth_mm), depth_mm: null };
    const { depth_mm, side } = await depthsOf(bytes, order.step_mm, order.offset_mm);
    const painted = paint(depth_mm, side, order.mm_per_px, order.style);
    return { id, is: "done", picture: await createImageBitmap(painted), depth_mm };
  } finally {
    stoppers.delete(id);
  }
}

self.onmessage = (event: MessageEvent<Order>) => {
  const order = event.data;
  if (order.is === "stop") {
    stoppers.get(order.id)?.abort();
    return;
  }
  follow(order)
    .catch((): Delivery => ({ id: order.id, is: "failed" }))
    .then((delivery) => {
      const handed: Transferable[] = [];
      if (delivery.is === "done") {
        handed.push(delivery.picture);
        if (delivery.depth_mm !== null) handed.push(delivery.depth_mm.buffer);
      }
      self.postMessage(delivery, { transfer: handed });
    });
};
