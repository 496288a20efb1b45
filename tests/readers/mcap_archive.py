"""Reads an archive with PyPI's mcap, all CRCs checked, and prints what is in it as one JSON object.

usage: mcap_archive.py FILE [VIDEO_OUT] : VIDEO_OUT gets the frames of /camera/video one after another.
"""

import json
import math
import struct
import sys

import numpy as np
from mcap.reader import make_reader
from mcap.records import Chunk, DataEnd, Footer
from mcap.stream_reader import StreamReader
from mcap_protobuf.decoder import DecoderFactory

KINDS = {1: "u1", 7: "<f4"}


def whole_file(path):
    """Every record in the order of the file; the reader raises where a chunk's or the data's CRC is wrong."""
    counts = {"chunks": 0, "compression": set(), "chunk_crcs": 0}
    with open(path, "rb") as f:
        for record in StreamReader(f, validate_crcs=True, emit_chunks=True).records:
            if isinstance(record, Chunk):
                counts["chunks"] += 1
                counts["compression"].add(record.compression)
                counts["chunk_crcs"] += int(record.uncompressed_crc != 0)
            elif isinstance(record, DataEnd):
                counts["data_crc"] = record.data_section_crc != 0
            elif isinstance(record, Footer):
                counts["summary_crc"] = record.summary_crc != 0
    counts["compression"] = sorted(counts["compression"])
    return counts


def packed(message, stride):
    dtype = np.dtype(
        {
            "names": [f.name for f in message.fields],
            "formats": [KINDS[f.type] for f in message.fields],
            "offsets": [f.offset for f in message.fields],
            "itemsize": stride,
        }
    )
    return np.frombuffer(message.data, dtype=dtype)


def cloud(message):
    points = packed(message, message.point_stride)
    first = [float(points[0][name]) for name in points.dtype.names] if len(points) else []
    return {"frame_id": message.frame_id, "points": len(points), "fields": list(points.dtype.names), "first": first}


def grid(message):
    cells = packed(message, message.cell_stride).reshape(-1, message.column_count)
    z = cells["elevation"]
    return {
        "frame_id": message.frame_id,
        "shape": list(cells.shape),
        "row_stride": message.row_stride,
        "origin": [message.pose.position.x, message.pose.position.y, message.pose.position.z],
        "cell": [message.cell_size.x, message.cell_size.y],
        "finite": int(np.isfinite(z).sum()),
        "first": float(np.nan_to_num(z[0, 0], nan=-1.0)),
        "sum": float(np.nansum(z.astype(np.float64))),
        "textured": int((cells["alpha"] == 255).sum()),
    }


def image32(message):
    z = np.frombuffer(message.data, "<f4").reshape(message.height, message.step // 4)
    last = float(z[-1, -1])
    # What was not measured is NaN, for which JSON has no word.
    return {"encoding": message.encoding, "shape": list(z.shape), "last": last if math.isfinite(last) else None}


def scene(message):
    def entity(e):
        (cube,), (text,) = e.cubes, e.texts
        p, s = cube.pose.position, cube.size
        return {
            "id": e.id,
            "frame_id": e.frame_id,
            "text": text.text,
            "position": [p.x, p.y, p.z],
            "size": [s.x, s.y, s.z],
            "metadata": {pair.key: pair.value for pair in e.metadata},
        }

    return {"entities": [entity(e) for e in message.entities]}


def stamps(message):
    for part in ("transforms", "entities"):
        if hasattr(message, part):
            return getattr(message, part)[0].timestamp
    return message.timestamp


def describe(topic, message):
    if topic in ("/surface", "/surface/overview", "/profile"):
        return cloud(message)
    if topic == "/defects":
        return scene(message)
    if topic == "/depth_map/image":
        return image32(message)
    if topic.startswith("/depth_map"):
        return grid(message)
    if topic in ("/tf", "/tf_static"):
        (transform,) = message.transforms
        t, r = transform.translation, transform.rotation
        return {
            "parent": transform.parent_frame_id,
            "child": transform.child_frame_id,
            "translation": [t.x, t.y, t.z],
            "rotation": [r.x, r.y, r.z, r.w],
        }
    if topic == "/camera/calibration":
        return {"model": message.distortion_model, "D": list(message.D), "K": list(message.K), "P": list(message.P)}
    if topic.startswith("/camera/"):
        return {"format": message.format, "bytes": len(message.data)}
    if topic == "/log":
        return {"level": message.level, "message": message.message}
    return message


def main(path, video_out=None):
    out = {"file": whole_file(path), "topics": {}, "attachments": {}, "metadata": {}}
    video = open(video_out, "wb") if video_out else None
    with open(path, "rb") as f:
        reader = make_reader(f, validate_crcs=True, decoder_factories=[DecoderFactory()])
        statistics = reader.get_summary().statistics
        out["statistics"] = {
            "messages": statistics.message_count,
            "start_ns": statistics.message_start_time,
            "end_ns": statistics.message_end_time,
            "chunks": statistics.chunk_count,
        }
        for attachment in reader.iter_attachments():
            out["attachments"][attachment.name] = {
                "media_type": attachment.media_type,
                "text": attachment.data.decode(errors="replace")[:4000],
            }
        for metadata in reader.iter_metadata():
            out["metadata"][metadata.name] = metadata.metadata
        for schema, channel, message in reader.iter_messages():
            topic = out["topics"].setdefault(
                channel.topic,
                {"schema": schema.name, "encoding": channel.message_encoding, "times_ns": [], "stamps_ns": [], "of": []},
            )
            topic["times_ns"].append(message.log_time)
            if channel.message_encoding == "json":
                content = json.loads(message.data)
            else:
                content = DecoderFactory().decoder_for(channel.message_encoding, schema)(message.data)
                stamp = stamps(content)
                topic["stamps_ns"].append(stamp.seconds * 1_000_000_000 + stamp.nanos)
                if channel.topic == "/camera/video" and video:
                    video.write(content.data)
            topic["of"].append(describe(channel.topic, content))
    print(json.dumps(out))


main(*sys.argv[1:])
