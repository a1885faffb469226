#!/usr/bin/env bash
# Make a Python environment and install pcfix in it.
#
#   bash samples/install.sh [FOLDER] [EXTRAS]
#
# FOLDER   of the environment, default .venv in this checkout
# EXTRAS   such as "vector,photos" or "test", default "vector": maps and shorelines
#
# Needs Python 3.11 or newer; PYTHON=... names another program than python3. On Debian and Ubuntu,
# venv and the libraries that open3d needs are installed with apt if possible, else their names are
# printed.
set -euo pipefail
cd "$(dirname "$0")/.."
folder=${1:-.venv}
extras=[${2:-vector}]
python=${PYTHON:-python3}

as_root() {
    if [ "$(id -u)" = 0 ]; then "$@"; elif command -v sudo >/dev/null; then sudo "$@"; else return 1; fi
}

# Only one installation at a time may use apt.
system_packages() (
    if command -v flock >/dev/null; then flock 9; fi
    if command -v apt-get >/dev/null && as_root apt-get update -qq &&
        as_root env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "$@" >/dev/null; then
        exit
    fi
    echo "install.sh: please install: $*" >&2
) 9<samples/install.sh

if ! "$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))'; then
    echo "install.sh: pcfix needs Python 3.11 or newer, this is $("$python" --version)" >&2
    exit 1
fi
missing=()
"$python" -c 'import ensurepip, venv' 2>/dev/null || missing+=(python3-venv)
if [ "$(uname -s)" = Linux ] && command -v ldconfig >/dev/null; then
    libraries=$(ldconfig -p)
    for pair in libgomp.so.1=libgomp1 libGL.so.1=libgl1 libEGL.so.1=libegl1 libX11.so.6=libx11-6; do
        case $libraries in *"${pair%=*}"*) ;; *) missing+=("${pair#*=}") ;; esac
    done
fi
if [ ${#missing[@]} -gt 0 ]; then system_packages "${missing[@]}"; fi

if [ ! -x "$folder/bin/python" ]; then "$python" -m venv "$folder"; fi
# uv is seven times as fast as pip; if it cannot reach an index, pip is used.
pip=("$folder/bin/python" -m pip)
"${pip[@]}" install --quiet --upgrade pip uv || "${pip[@]}" install --quiet --upgrade pip
index=${PIP_INDEX_URL:-$("${pip[@]}" config get global.index-url 2>/dev/null || true)}
what=(--quiet --editable ".$extras")
UV_NATIVE_TLS=true "$folder/bin/uv" pip install --python "$folder/bin/python" \
    ${index:+--default-index "$index"} "${what[@]}" || "${pip[@]}" install "${what[@]}"
if [ -z "${2:-}" ]; then
    echo "compiling the kernels, which would otherwise delay the first correction ..."
    warm=$(mktemp -d)
    "$folder/bin/pcfix" correct samples/scene/cloud.laz "$warm/out.laz" \
        --cameras samples/scene/cameras.csv --water 0.37 --quiet
    rm -r "$warm"
fi
echo "pcfix $("$folder/bin/python" -c 'import pcfix; print(pcfix.__version__)') is in $folder"
