#!/usr/bin/env bash
# Speed of the method on this machine as ratios to bare decoding, all taken in one run; and its peak memory for that
# run and for one six times as long.
#   tests/speed.sh [SCENE] [WxH] [SECONDS]
set -euo pipefail
cd "$(dirname "$0")/.."

scene="${1:-pipe}" size="${2:-1280x720}" seconds="${3:-8}"
work="$(mktemp -d)"
trap 'rm -rf "$work"' EXIT
stria=target/release/stria
for tool in "$stria" ffmpeg python3; do
  command -v "$tool" >/dev/null || { echo "$tool is missing: run 'make build' first" >&2; exit 1; }
done

"$stria" simulate "$scene" --out "$work/run" --size "$size" --seconds "$seconds" --seed 7 >/dev/null 2>&1
frames="$(ffprobe -v error -count_packets -select_streams v -show_entries stream=nb_read_packets -of csv=p=0 "$work/run/video.mp4")"

seconds_of() {
  local start end
  start="$(date +%s.%N)"
  "$@" >/dev/null 2>&1 || [ $? = 3 ] # 3: done with warnings
  end="$(date +%s.%N)"
  echo "$end $start" | awk '{ print $1 - $2 }'
}

decode="$(seconds_of ffmpeg -v error -i "$work/run/video.mp4" -f null -)"
measure="$(seconds_of "$stria" process "$work/run/video.mp4" --rig "$work/run/rig.toml" --recipe paper --only depth,cloud,trajectory --out "$work/few")"
all="$(seconds_of "$stria" process "$work/run/video.mp4" --rig "$work/run/rig.toml" --recipe paper --out "$work/all")"

peak_mb_of() {
  python3 -c 'import resource, subprocess, sys
subprocess.run(sys.argv[1:], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss // 1024)' "$@"
}

ffmpeg -v error -stream_loop 5 -i "$work/run/video.mp4" -c copy "$work/long.mp4"
short_mb="$(peak_mb_of "$stria" process "$work/run/video.mp4" --rig "$work/run/rig.toml" --recipe paper --out "$work/short")"
long_mb="$(peak_mb_of "$stria" process "$work/long.mp4" --rig "$work/run/rig.toml" --recipe paper --out "$work/long")"

echo "$frames frames of $scene at $size, $(nproc) cores"
awk -v n="$frames" -v d="$decode" -v m="$measure" -v a="$all" 'BEGIN {
  printf "%-38s %7.1f frames/s\n", "bare decoding (ffmpeg -f null)", n / d
  printf "%-38s %7.1f frames/s   %.3f of decoding\n", "paper: depth, cloud, trajectory", n / m, d / m
  printf "%-38s %7.1f frames/s   %.3f of decoding\n", "paper: all products", n / a, d / a
}'
echo "peak memory of all products: $short_mb MB for this run, $long_mb MB for one six times as long"
