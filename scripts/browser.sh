#!/usr/bin/env bash
# Debian's Chromium, in which the tests of the live page run; without it they are skipped, so a failure is only told.
set -u

command -v chromium >/dev/null 2>&1 && exit 0
tell() { echo "chromium: $1; the tests of the live page are skipped without it" >&2; exit 0; }
command -v apt-get >/dev/null 2>&1 || tell "no apt-get here, install it by hand"
run=()
if [ "$(id -u)" -ne 0 ]; then
  sudo -n true 2>/dev/null || tell "not root, so skipped; run: sudo apt-get install chromium"
  run=(sudo -n)
fi
export DEBIAN_FRONTEND=noninteractive
install() { timeout 400 "${run[@]}" apt-get install -y -qq --no-install-recommends chromium >/dev/null 2>&1; }
install || { timeout 120 "${run[@]}" apt-get update -qq >/dev/null 2>&1; install; } || tell "could not be installed"
