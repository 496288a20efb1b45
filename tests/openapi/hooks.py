"""What schemathesis does not know of itself: a piece of a tus upload is its bytes."""

import schemathesis


@schemathesis.serializer("application/offset+octet-stream")
def piece(_context, value):
    return value if isinstance(value, bytes) else str(value).encode()
