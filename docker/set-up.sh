#!/usr/bin/env bash
# Installs what a fresh Debian 12 with Rust, Node and make lacks. Safe to run again: it does only what is missing.
#   docker/set-up.sh            to build, run and test
#   docker/set-up.sh build      to build only (the container image's first stage)
#   docker/set-up.sh run        to run the built binary only (the container image's last stage)
set -euo pipefail
cd "$(dirname "$0")/.."

BUILD="build-essential pkg-config clang libclang-dev libopencv-dev
  libavcodec-dev libavformat-dev libavutil-dev"
RUN="libopencv-core406 libopencv-imgproc406 libopencv-video406 libopencv-calib3d406
  libavcodec59 libavformat59 libavutil57 ca-certificates"
TEST="ffmpeg chromium python3-venv curl openssl postgresql"

case "${1:-all}" in
  build) packages="$BUILD" ;;
  run) packages="$RUN" ;;
  all) packages="$BUILD $TEST" ;;
  *) echo "usage: docker/set-up.sh [build|run]" >&2; exit 2 ;;
esac

missing=""
for package in $packages; do
  dpkg-query -W -f '${Status}' "$package" 2>/dev/null | grep -q "install ok installed" || missing="$missing $package"
done
if [ -n "$missing" ]; then
  echo "Installing Debian packages:$missing"
  sudo=""
  if [ "$(id -u)" != 0 ]; then
    command -v sudo >/dev/null || { echo "These packages are missing and there is no sudo; as root, run: apt-get install$missing" >&2; exit 1; }
    sudo=sudo
  fi
  $sudo apt-get update -qq
  # shellcheck disable=SC2086
  DEBIAN_FRONTEND=noninteractive $sudo apt-get install -y -qq --no-install-recommends $missing
fi

if [ "${1:-all}" = all ]; then
  # Readers that we did not write, for the tests of the file formats; exact versions.
  python=target/python
  if ! cmp -s tests/requirements.txt "$python/requirements.txt"; then
    rm -rf "$python"
    mkdir -p target
    /usr/bin/python3 -m venv "$python"
    "$python/bin/pip" install --quiet --disable-pip-version-check -r tests/requirements.txt
    cp tests/requirements.txt "$python/requirements.txt"
  fi
  if ! cmp -s tests/browser/package-lock.json tests/browser/node_modules/.installed; then
    (cd tests/browser && npm ci --no-audit --no-fund)
    cp tests/browser/package-lock.json tests/browser/node_modules/.installed
  fi
fi
