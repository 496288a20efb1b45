#!/usr/bin/env bash
# The main job on a realistic example: simulates a robot's run along a pipe, starts the server, sends the run in
# through the HTTP API, waits for the result, and leaves the server running until Ctrl-C.
set -euo pipefail
cd "$(dirname "$0")/.."

stria=target/release/stria
demo=target/demo
listen="${STRIA_LISTEN:-127.0.0.1:8420}"

if [ ! -e "$demo/run/truth/surface.json" ]; then
  rm -rf "$demo/run"
  echo "Simulating a robot's run along a pipe (once; it stays in $demo/run)."
  "$stria" simulate pipe --out "$demo/run" --seconds 8 --seed 7
fi

# The demo asks nobody for a token: it listens on this machine's loopback only.
"$stria" serve --listen "$listen" --data "$demo/data" --without-authentication &
server=$!
trap 'kill "$server" 2>/dev/null || true; wait "$server" 2>/dev/null || true' EXIT
trap 'exit 130' INT TERM

"$stria" send "$demo/run/video.mp4" --server "http://$listen" --asset "Demo pipe" --rig "$demo/run/rig.toml" --wait
kill -0 "$server"
echo
echo "The server keeps running; Ctrl-C stops it."
wait "$server"
