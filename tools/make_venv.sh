#!/bin/sh
# Make a virtual environment: make_venv.sh DIRECTORY [PYTHON]. Says what is missing when it cannot.
set -eu

directory=$1
candidates=${2:-"python3.11 python3 python3.12 python3.13 python3.14 python"}

python=
for candidate in $candidates; do
    if "$candidate" -c 'import sys; sys.exit(sys.version_info < (3, 11))' >/dev/null 2>&1; then
        python=$candidate
        break
    fi
done
if [ -z "$python" ]; then
    echo "autotune needs Python 3.11 or later; none of these is one: $candidates." >&2
    echo "Install it, or name it: make PYTHON=/path/to/python3.11" >&2
    exit 1
fi
if ! "$python" -c 'import ensurepip, venv' >/dev/null 2>&1; then
    version=$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])')
    echo "$python ($version) cannot make virtual environments: its modules venv and ensurepip are not installed." >&2
    echo "On Debian and Ubuntu: apt-get install python$version-venv" >&2
    exit 1
fi
echo "Making the virtual environment $directory with $("$python" --version) ..."
if ! "$python" -m venv --clear "$directory"; then
    rm -rf "$directory"
    echo "The virtual environment could not be made; see above." >&2
    exit 1
fi
