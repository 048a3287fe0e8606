#!/usr/bin/env bash
# A virtual environment with pip, of a Python that the package supports. What an interrupt left of one is completed.
set -u

venv=$1 python=$2
new_enough() { "$1" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; }
refuse() { echo "$1" >&2; exit 1; }
cure="name one, e.g. make PYTHON=python3.12 train"

if [ -x "$venv/bin/python" ]; then
  new_enough "$venv/bin/python" ||
    refuse "$venv has $("$venv/bin/python" --version 2>&1), Python 3.11 or later is needed: remove $venv and $cure"
  "$venv/bin/python" -m pip --version >/dev/null 2>&1 && exit 0
fi
command -v "$python" >/dev/null 2>&1 || refuse "no Python called $python here: $cure"
new_enough "$python" || refuse "$python is $("$python" --version 2>&1), Python 3.11 or later is needed: $cure"
echo "$python -m venv $venv"
exec "$python" -m venv "$venv"
