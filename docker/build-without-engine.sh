#!/usr/bin/env bash
# Builds the image of docker/Dockerfile without a container engine: every stage is a folder that debootstrap made, every
# instruction of the Dockerfile is carried out in it, in its order, on the files that git has. At the end the image is
# started as its own user, and its health check must answer. Needs root and debootstrap.
#   docker/build-without-engine.sh --plan                  says the steps and does nothing
#   docker/build-without-engine.sh FOLDER [--resume] [--overlay DIR] [--env NAME=VALUE]...
# FOLDER gets a folder for each stage (6 GB); the image is FOLDER/image. --resume goes on after the last step that an
# earlier run brought to its end, with that run's files. Images that are not Debian's own are Debian with
# this machine's Node or Rust, of the version that the image's tag names. DIR is laid over each stage before each command,
# and the variables are set for them: the certificates and mirrors of a network that needs its own.
set -euo pipefail
cd "$(dirname "$0")/.."

usage="usage: docker/build-without-engine.sh --plan | FOLDER [--resume] [--overlay DIR] [--env NAME=VALUE]..."
fail() { echo "build-without-engine.sh: $*" >&2; exit 1; }

plan=no resume=no work="" overlay="" variables=()
while [ $# -gt 0 ]; do
  case "$1" in
    --plan) plan=yes ;;
    --resume) resume=yes ;;
    --overlay) overlay="${2:?$usage}"; shift ;;
    --env) variables+=("${2:?$usage}"); shift ;;
    -*) echo "$usage" >&2; exit 2 ;;
    *) [ -z "$work" ] || { echo "$usage" >&2; exit 2; }; work="$1" ;;
  esac
  shift
done
[ "$plan" = yes ] || [ -n "$work" ] || { echo "$usage" >&2; exit 2; }

release=bookworm
declare -A arguments=()
before=() within=() server=""
stage="" workdir=/ user=0:0 entrypoint="" command="" check=""

# The folder of a stage.
folder() { echo "$work/$1"; }

# Makes `within` the start of a command line that works in a stage's folder, as a user, with nothing of this machine's
# environment. Process and mount tables are its own: what is started or mounted there ends with it.
enter() {
  [ -z "$overlay" ] || cp -a "$overlay/." "$(folder "$2")/"
  within=(unshare --fork --pid --mount --kill-child bash -c '
    mount -t proc proc "$1/proc"; mount --rbind /dev "$1/dev"
    cp /etc/resolv.conf "$1/etc/resolv.conf" 2>/dev/null || true
    exec chroot --userspec="$2" "$1" /usr/bin/env -i "${@:3}"'
    - "$(folder "$2")" "$1" HOME=/root LANG=C.UTF-8
    PATH=/usr/local/rust/bin:/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin
    ${variables[@]+"${variables[@]}"})
}

# A command in a stage's folder, as a user.
inside() {
  enter "$1" "$2"
  "${within[@]}" "${@:3}"
}

# Debian, made once.
debian() {
  if [ ! -e "$work/debian/etc/debian_version" ]; then
    rm -rf "$work/debian"
    debootstrap --variant=minbase "$1" "$work/debian" > "$work/debootstrap.log" || fail "see $work/debootstrap.log"
  fi
}

check_image() {
  case "$1" in
    debian:"$release"* | node:*-"$release"* | rust:*-"$release"*) ;;
    *) fail "FROM $1: no image of Debian $release, of node or of rust" ;;
  esac
}

# A stage begins: Debian, and what an image of this name has besides.
from() {
  local image="$1"
  debian "$release"
  rm -rf "$(folder "$stage")"
  cp -a --reflink=auto "$work/debian" "$(folder "$stage")"
  local root wanted; root="$(folder "$stage")"
  wanted="${image#*:}"; wanted="${wanted%%-*}"
  case "$image" in
    node:*)
      [[ "$(node --version)" == "v$wanted."* ]] || fail "$image: this machine has Node $(node --version)"
      mkdir -p "$root/usr/local/lib/node_modules"
      cp "$(node -p process.execPath)" "$root/usr/local/bin/node"
      cp -a "$(npm root --global)/npm" "$root/usr/local/lib/node_modules/npm"
      ln -s ../lib/node_modules/npm/bin/npm-cli.js "$root/usr/local/bin/npm" ;;
    rust:*)
      [[ "$(rustc --version)" == "rustc $wanted."* ]] || fail "$image: this machine has $(rustc --version)"
      mkdir "$root/usr/local/rust"
      cp -a "$(rustc --print sysroot)/bin" "$(rustc --print sysroot)/lib" "$root/usr/local/rust/"
      inside 0:0 "$stage" sh -c 'apt-get update -qq && apt-get install -y -qq --no-install-recommends ca-certificates git' \
        > "$work/$stage.base.log" 2>&1 || fail "see $work/$stage.base.log" ;;
  esac
}

# COPY [--from=STAGE] SOURCE... TARGET
copy() {
  local source_root="$work/context"
  if [[ "$1" == --from=* ]]; then source_root="$(folder "${1#--from=}")"; shift; fi
  local target="${*: -1}" root; root="$(folder "$stage")"
  [[ "$target" == /* ]] || target="${workdir%/}/$target"
  local source
  for source in "${@:1:$#-1}"; do
    if [ -d "$source_root/$source" ]; then
      mkdir -p "$root$target" && cp -a "$source_root/$source/." "$root$target/"
    elif [[ "$target" == */ || "$target" == */. ]]; then
      mkdir -p "$root$target" && cp -a "$source_root/$source" "$root$target"
    else
      mkdir -p "$root$(dirname "$target")" && cp -a "$source_root/$source" "$root$target"
    fi
  done
}

# Says a step, and whether it must be done: not where only the plan is asked for, or an earlier run has done it.
begins() {
  echo "$1"
  [ "$plan" = no ] || return 1
  if [ ${#before[@]} -gt 0 ]; then
    [ "${before[0]}" = "$1" ] || fail "--resume: the earlier run did '${before[0]}' here"
    before=("${before[@]:1}")
    return 1
  fi
}

ends() { echo "$1" >> "$work/done"; }

step() {
  local instruction="$1" rest="$2" words
  read -ra words <<< "$rest"
  case "$instruction" in
    ARG) arguments["${rest%%=*}"]="${rest#*=}" ;;
    FROM)
      local image="${words[0]}" name
      if [[ "$image" =~ ^\$\{(.+)\}$ ]]; then image="${arguments[${BASH_REMATCH[1]}]}"; fi
      stage="${words[2]:-image}" workdir=/ user=0:0
      check_image "$image"
      if begins "[$stage] FROM $image"; then from "$image"; ends "[$stage] FROM $image"; fi ;;
    WORKDIR) workdir="$rest"; [ "$plan" = yes ] || mkdir -p "$(folder "$stage")$workdir" ;;
    COPY) if begins "[$stage] COPY $rest"; then copy "${words[@]}"; ends "[$stage] COPY $rest"; fi ;;
    RUN)
      if begins "[$stage] RUN $rest"; then
        inside "$user" "$stage" sh -c "cd '$workdir' && $rest"
        ends "[$stage] RUN $rest"
      fi ;;
    USER) user="$rest" ;;
    ENTRYPOINT) entrypoint="$rest" ;;
    CMD) command="$rest" ;;
    HEALTHCHECK) check="${rest#*CMD }" ;;
    VOLUME | EXPOSE) ;;
    *) fail "docker/Dockerfile: $instruction is no instruction that is known here" ;;
  esac
}

# ["a", "b"] as lines.
listed() { grep -o '"[^"]*"' <<< "$1" | tr -d '"'; }

# Starts the image as it says itself; its health check must answer.
try() {
  local start healthy port
  mapfile -t start < <(listed "$entrypoint"; listed "$command")
  mapfile -t healthy < <(listed "$check")
  echo "[image] ${start[*]} (as $user)"
  [ "$plan" = yes ] && { echo "[image] ${healthy[*]}"; return; }
  port="${healthy[-1]}"
  (: < "/dev/tcp/127.0.0.1/$port") 2> /dev/null && fail "port $port of this machine is taken, the image cannot be tried"
  enter "$user" image
  "${within[@]}" "${start[@]}" > "$work/image.log" 2>&1 &
  server=$!
  # What became another user does not die with unshare: it is named here.
  trap 'kill -KILL $(cat "/proc/$server/task/$server/children" 2> /dev/null) "$server" 2> /dev/null || true' EXIT
  for _ in $(seq 60); do
    sleep 1
    kill -0 "$server" 2>/dev/null || fail "it ended: see $work/image.log"
    if inside "$user" image "${healthy[@]}" 2>/dev/null; then
      echo "[image] ${healthy[*]}: healthy on port $port; the image has $(du -sm "$work/image" | cut -f1) MB"
      return
    fi
  done
  fail "not healthy after a minute: see $work/image.log"
}

if [ "$plan" = no ]; then
  [ "$(id -u)" = 0 ] || fail "needs root"
  for program in debootstrap git node npm rustc unshare; do
    command -v "$program" > /dev/null || fail "$program is missing"
  done
  mkdir -p "$work"
  work="$(cd "$work" && pwd)"
  if [ "$resume" = yes ]; then
    [ ! -e "$work/done" ] || mapfile -t before < "$work/done"
  else
    rm -rf "$work/context" "$work/done" && mkdir "$work/context"
    git archive HEAD | tar -x -C "$work/context"
  fi
fi

line=""
while IFS= read -r next || [ -n "$next" ]; do
  [[ "$next" =~ ^[[:space:]]*(#|$) ]] && continue
  line="$line$next"
  if [[ "$line" == *\\ ]]; then line="${line%\\} "; continue; fi
  read -r instruction rest <<< "$line"
  step "$instruction" "$rest"
  line=""
done < docker/Dockerfile
try
