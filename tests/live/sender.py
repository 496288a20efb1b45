"""Sends a folder of JPEG images as a live stream, as a robot would: the whole protocol in some fifty lines of code.

usage: sender.py ws://HOST/api/live/NAME ASSET RIG_FILE FOLDER FPS [FIRST_LEFT_OUT LAST_LEFT_OUT]
Prints what the server says as JSON lines, and for each frame when it was sent: {"sent": seq, "at": s since 1970}.
"""

import asyncio
import json
import os
import struct
import sys
import time
from pathlib import Path

import google_crc32c
import websockets

URL, ASSET, RIG, FOLDER, FPS = sys.argv[1:6]
LEFT_OUT = range(int(sys.argv[6]), int(sys.argv[7]) + 1) if len(sys.argv) > 7 else range(0)
START = time.time()


def frame(seq, image):
    return struct.pack("<QqI", seq, time.time_ns(), google_crc32c.value(image)) + image


async def send_all(images, finished):
    doors = {"Authorization": f"Bearer {os.environ['STRIA_TOKEN']}"} if "STRIA_TOKEN" in os.environ else {}
    async with websockets.connect(URL, max_size=None, additional_headers=doors) as socket:
        hello = {"type": "hello", "asset": ASSET, "rig": Path(RIG).read_text(), "fps": float(FPS), "resume": True}
        await socket.send(json.dumps(hello))
        welcome = json.loads(await socket.recv())
        print(json.dumps(welcome), flush=True)
        state = {"durable": welcome["next_seq"] - 1, "credit": welcome["credit"]}

        async def listen():
            async for text in socket:
                said = json.loads(text)
                print(json.dumps(said), flush=True)
                if said["type"] == "ack":
                    state.update(durable=said["durable_seq"], credit=said["credit"])
                finished.extend([said] if said["type"] in ("closed", "error") else [])

        ears = asyncio.create_task(listen())
        ears.add_done_callback(lambda done: done.cancelled() or done.exception())  # said where it is awaited
        for seq in range(welcome["next_seq"], len(images)):
            await asyncio.sleep(max(0.0, START + seq / float(FPS) - time.time()))
            while seq > state["durable"] + state["credit"] and not ears.done():
                await asyncio.sleep(0.005)
            if seq not in LEFT_OUT:
                print(json.dumps({"sent": seq, "at": time.time()}), flush=True)
                await socket.send(frame(seq, images[seq].read_bytes()))
        await socket.send('{"type":"end"}')
        await ears


async def main():
    images, finished = sorted(Path(FOLDER).glob("*.jpg")), []
    while not finished:
        try:
            await send_all(images, finished)
        except (OSError, websockets.WebSocketException) as error:
            print(json.dumps({"lost": str(error)}), flush=True)
            await asyncio.sleep(0.2)
    sys.exit(0 if finished[-1]["type"] == "closed" else 1)


asyncio.run(main())
