#!/usr/bin/env bash
# PostgreSQL for the search's database test (tests/test_tune_workers.py), from Debian's own packages. The test starts a
# private server of its own; the packaged cluster is neither started nor touched.
set -eu
if command -v postgres >/dev/null 2>&1 || ls /usr/lib/postgresql/*/bin/postgres >/dev/null 2>&1; then
  echo "PostgreSQL is there already"
  exit 0
fi
command -v apt-get >/dev/null 2>&1 || { echo "no apt-get here: install PostgreSQL by hand" >&2; exit 2; }
run=()
[ "$(id -u)" -eq 0 ] || run=(sudo -n)
export DEBIAN_FRONTEND=noninteractive
"${run[@]}" mkdir -p /etc/postgresql-common/createcluster.d
echo "create_main_cluster = false" | "${run[@]}" tee /etc/postgresql-common/createcluster.d/no-main.conf >/dev/null
"${run[@]}" apt-get install -y -qq --no-install-recommends postgresql
