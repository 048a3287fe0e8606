#!/usr/bin/env bash
# System packages that wheels do not bring: a C++ compiler (compiled updates), Python headers and virtual environments,
# and software OpenGL (rendering MuJoCo without a screen). Training works without them, so a failure here is only told.
set -u

missing=()
command -v g++ >/dev/null 2>&1 || missing+=(g++)
python=${PYTHON:-python3}
if command -v "$python" >/dev/null 2>&1; then
  "$python" -c 'import ensurepip' 2>/dev/null || missing+=(python3-venv)
  header=$("$python" -c 'import sysconfig; print(sysconfig.get_path("include"))')/Python.h
  [ -f "$header" ] || missing+=(python3-dev)
fi
has_library() { { ldconfig -p 2>/dev/null || /sbin/ldconfig -p 2>/dev/null; } | grep -q "$1"; }
has_library libOSMesa || missing+=(libosmesa6)
has_library libEGL.so || missing+=(libegl1)
has_file() { compgen -G "$1" >/dev/null; } # EGL finds no way to draw without a driver, be it the one in software
has_file '/usr/lib*/*/dri/swrast_dri.so' || has_file '/usr/lib*/dri/swrast_dri.so' || has_library libgallium- ||
  missing+=(libgl1-mesa-dri)

[ ${#missing[@]} -eq 0 ] && exit 0

tell() { echo "system packages: $1 (wanted: ${missing[*]}); training works without them" >&2; exit 0; }

command -v apt-get >/dev/null 2>&1 || tell "no apt-get here, install the equivalents by hand for speed and rendering"
run=()
if [ "$(id -u)" -ne 0 ]; then
  sudo -n true 2>/dev/null || tell "not root, so skipped; run: sudo apt-get install ${missing[*]}"
  run=(sudo -n)
fi
echo "system packages: installing ${missing[*]}"
export DEBIAN_FRONTEND=noninteractive
install() { timeout 240 "${run[@]}" apt-get install -y -qq --no-install-recommends "$1" >/dev/null 2>&1; }
failed=()
updated=no
for package in "${missing[@]}"; do
  install "$package" && continue
  if [ "$updated" = no ]; then
    timeout 120 "${run[@]}" apt-get update -qq >/dev/null 2>&1
    updated=yes
    install "$package" && continue
  fi
  failed+=("$package")
done
missing=("${failed[@]+"${failed[@]}"}")
[ ${#missing[@]} -eq 0 ] || tell "could not be installed"
