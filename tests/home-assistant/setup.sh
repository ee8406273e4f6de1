#!/bin/bash
# Makes .home-assistant/VERSION/ at the top of the repository: a real Home Assistant core with what its MQTT
# integration needs, from Debian's and Python's package registries. Nothing is installed on the machine:
# where it does not have the Python that this core asks for, Debian's is unpacked there too. About 830 MB and
# two minutes for each version; the second time nothing. Prints the folder.
set -euo pipefail

# The newest, and the oldest that busker's option `minimum_version` knows.
version=${1:-2026.11}
case $version in
    2026.11) release=2026.11.0 python=3.14 suite=forky ;;
    2025.4)  release=2025.4.4  python=3.13 suite=trixie ;;
    *)
        echo "No Home Assistant $version is set up here; VERSION is 2026.11 or 2025.4" >&2
        exit 2
        ;;
esac

top=$(cd "$(dirname "$0")/../.." && pwd)
place=$top/.home-assistant/$version
ready=$place/ready-$release
export PIP_DISABLE_PIP_VERSION_CHECK=1

main() {
    [ -e "$ready" ] && return
    rm -rf "$place"
    mkdir -p "$place"
    local interpreter
    interpreter=$(command -v "python$python" || true)
    # A version manager may answer to the name and have no such Python.
    if [ -z "$interpreter" ] || ! "$interpreter" -c 'import ssl, sqlite3' 2>/dev/null; then
        unpack_python
        interpreter=$place/debian/usr/bin/python
    fi
    make_environment "$interpreter"
    touch "$ready"
}

# Debian's python3.x with everything it needs, C library included, unpacked under debian/; usr/bin/python there
# starts it with the libraries that came with it.
unpack_python() {
    local apt=$place/apt debian=$place/debian mirror loader libraries
    mkdir -p "$apt"/{lists/partial,archives/partial,sources} "$debian"
    mirror=$(apt-get indextargets --format '$(REPO_URI)' 'Identifier: Packages' | grep -v security | head -1)
    printf 'Types: deb\nURIs: %s\nSuites: %s\nComponents: main\nSigned-By: %s\n' \
        "$mirror" "$suite" /usr/share/keyrings/debian-archive-keyring.gpg >"$apt/sources/$suite.sources"
    : >"$apt/status"
    local options=(
        -qq -o Dir::Etc::sourcelist=/dev/null -o Dir::Etc::sourceparts="$apt/sources"
        -o Dir::State::lists="$apt/lists" -o Dir::State::status="$apt/status"
        -o Dir::Cache="$apt" -o Dir::Cache::archives="$apt/archives"
        -o APT::Sandbox::User= -o Debug::NoLocking=1
    )
    apt-get "${options[@]}" update
    # With no package marked as installed this takes all that they depend on, too.
    apt-get "${options[@]}" install --yes --download-only --no-install-recommends \
        "python$python" "libpython$python-dev" python3-pip-whl >"$apt/log"
    for package in "$apt"/archives/*.deb; do
        dpkg-deb --extract "$package" "$debian"
    done
    rm -rf "$apt"

    loader=$(find "$debian/usr/lib/" -name 'ld-linux*.so*' -type f | head -1)
    libraries=$(dirname "$loader")
    # Named as itself, so that Python finds the environment that the link to it belongs to.
    printf '#!/bin/sh\nexec %s --library-path %s --argv0 "$0" %s "$@"\n' \
        "$loader" "$libraries" "$debian/usr/bin/python$python" >"$debian/usr/bin/python"
    chmod +x "$debian/usr/bin/python"
}

make_environment() {
    local interpreter=$1 wheel
    "$interpreter" -m venv --without-pip "$place/venv"
    # The newest of Debian's pip, or the one that the machine's Python has.
    wheel=$(find "$place/debian" /usr/share/python-wheels -name 'pip-*.whl' 2>/dev/null | head -1)
    local pip=("$place/venv/bin/python" -m pip --quiet)
    # What has no wheel for this Python is compiled; the machine's own headers come first.
    export CFLAGS="-idirafter $place/debian/usr/include" CXXFLAGS="-idirafter $place/debian/usr/include"
    PYTHONPATH=$wheel "${pip[@]}" install pip
    "${pip[@]}" install "homeassistant==$release"
    # Home Assistant would install these itself at its first start; here nothing is downloaded at run time.
    "$place/venv/bin/python" "$top/tests/home-assistant/requirements.py" >"$place/requirements.txt"
    "${pip[@]}" install --constraint "$place/venv/lib/python$python/site-packages/homeassistant/package_constraints.txt" \
        --requirement "$place/requirements.txt"
}

main >&2
echo "$place"
