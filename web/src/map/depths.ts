// A depth tile read back, as `core/src/export/tiles.rs` writes it.

let reader: OffscreenCanvasRenderingContext2D | null = null;

/** The depths of a tile's picture, exactly: no colour management, no transparency touches the bytes. */
export async function depthsOf(bytes: Blob, step_mm: number, offset_mm: number): Promise<{ depth_mm: Float32Array; side: number }> {
  const image = await createImageBitmap(bytes, { colorSpaceConversion: "none", premultiplyAlpha: "none" });
  const side = image.width;
  if (reader === null || reader.canvas.width !== side) {
    reader = new OffscreenCanvas(side, side).getContext("2d", { willReadFrequently: true });
    if (reader === null) throw new Error("no canvas");
  }
  reader.globalCompositeOperation = "copy";
  reader.drawImage(image, 0, 0);
  image.close();
  const { data } = reader.getImageData(0, 0, side, side);
  const depth_mm = new Float32Array(side * side);
  for (let at = 0; at < depth_mm.length; at += 1) {
    const value = data[4 * at]! * 65536 + data[4 * at + 1]! * 256 + data[4 * at + 2]!;
    depth_mm[at] = value === 0 ? NaN : value * step_mm + offset_mm;
  }
  return { depth_mm, side };
}
