#!/usr/bin/env bash
# Exit code 0 where the server on this machine's port $1 is ready. Needs nothing but bash: the image has no curl.
set -euo pipefail
port="${1:?the port}"
exec 3<>"/dev/tcp/127.0.0.1/$port"
printf 'GET /readyz HTTP/1.1\r\nHost: 127.0.0.1:%s\r\nConnection: close\r\n\r\n' "$port" >&3
read -r -t 4 _ status _ <&3
[ "$status" = 200 ]
