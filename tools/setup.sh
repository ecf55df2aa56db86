#!/usr/bin/env bash
# Set up laser-slam: a virtual environment with the pinned packages, and Open3D's system libraries.
#
#   tools/setup.sh [FOLDER [EXTRAS]]     FOLDER: of the virtual environment, .venv by default
#                                        EXTRAS: such as dev, what the tests need
#
# A Python of one's own choice: PYTHON=/path/to/python3.12 tools/setup.sh
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
venv=${1:-.venv}
extras=${2:-}
system_packages=(libusb-1.0-0 libgl1 libegl1 libx11-6 libgomp1)

is_supported() { "$1" -c 'import sys; sys.exit(not (3, 11) <= sys.version_info < (3, 14))' 2>/dev/null; }

find_python() {
    local candidate
    for candidate in "${PYTHON:-python3}" python3.13 python3.12 python3.11; do
        if command -v "$candidate" >/dev/null && is_supported "$candidate"; then
            command -v "$candidate"
            return
        fi
    done
    echo "setup: laser-slam needs Python 3.11, 3.12 or 3.13; install one (apt-get install python3.12" \
        "python3.12-venv), or set PYTHON=/path/to/python" >&2
    return 1
}

make_venv() {
    local python
    python=$(find_python)
    if ! "$python" -m venv --clear "$venv"; then
        echo "setup: '$python -m venv' fails; installing Python's venv module"
        as_root apt-get update && as_root apt-get install -y python3-venv \
            && "$python" -m venv --clear "$venv" || {
            echo "setup: install Python's venv module, as root, then run this again:" \
                "apt-get install python3-venv" >&2
            return 1
        }
    fi
}

as_root() {
    if [ "$(id -u)" = 0 ]; then
        env DEBIAN_FRONTEND=noninteractive "$@"
    elif command -v sudo >/dev/null && sudo -n true 2>/dev/null; then
        sudo -n env DEBIAN_FRONTEND=noninteractive "$@"
    else
        return 1
    fi
}

open3d_loads() { "$venv/bin/python" -c 'from laser_slam.dependencies import import_open3d; import_open3d()' 2>&1; }

ensure_open3d() {
    open3d_loads >/dev/null && return
    echo "setup: Open3D lacks system libraries; installing ${system_packages[*]}"
    if command -v apt-get >/dev/null && as_root apt-get update \
        && as_root apt-get install -y --no-install-recommends "${system_packages[@]}" \
        && open3d_loads >/dev/null; then
        return
    fi
    open3d_loads | tail -n 1 >&2
    echo "setup: install what Open3D lacks, as root, then run this again:" \
        "apt-get install ${system_packages[*]}" >&2
    return 1
}

# A stamp newer than what it was made from means that nothing is to be done.
stamp=$venv/.laser-slam-is-set-up${extras:+-with-$extras}
for mark in "$stamp" "$venv/.laser-slam-is-set-up-with-dev"; do
    if [ "$mark" -nt pyproject.toml ] && [ "$mark" -nt constraints.txt ]; then
        exit 0
    fi
done
is_supported "$venv/bin/python" || make_venv
"$venv/bin/python" -m pip install --quiet --disable-pip-version-check -c constraints.txt -e ".${extras:+[$extras]}"
ensure_open3d
touch "$stamp"
echo "setup: done; 'source $venv/bin/activate' makes laser-slam a command"
