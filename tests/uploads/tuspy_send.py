"""Sends a file with tuspy as a program would use it, and prints what became of it as JSON.
    python tuspy_send.py ENDPOINT FILE METADATA_JSON
"""

import json
import sys
import time

from tusclient.client import TusClient
from tusclient.exceptions import TusCommunicationError

TRIES = 500
WAIT_S = 0.02
CHUNK_BYTES = 16 << 20


def main() -> None:
    endpoint, file, metadata = sys.argv[1:]
    uploader = TusClient(endpoint).uploader(
        file, metadata=json.loads(metadata), chunk_size=CHUNK_BYTES, retries=TRIES, retry_delay=WAIT_S
    )
    # tuspy itself tries only the pieces again, not the creation.
    for left in reversed(range(TRIES)):
        try:
            uploader.set_url(uploader.create_url())
            break
        except TusCommunicationError:
            if not left:
                raise
            time.sleep(WAIT_S)
    uploader.upload()
    told = uploader.request.response_headers
    print(json.dumps({"url": uploader.url, "run": told.get("stria-run"), "job": told.get("stria-job")}))


main()
