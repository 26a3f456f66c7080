#!/usr/bin/env bash
# Gradescope runs this once, as root, when it builds the container: Python >= 3.11 with NumPy and SciPy, and bubblewrap.
# Only the image's own apt and pip are asked. Variables in capitals are for trying it elsewhere.
set -euo pipefail
source=${DSIM_AUTOGRADER:-/autograder}/source
home=${DSIM_HOME:-/opt/dsim} # anybody may read it, so it holds nothing of the course
export DEBIAN_FRONTEND=noninteractive PIP_DISABLE_PIP_VERSION_CHECK=1 PIP_ROOT_USER_ACTION=ignore

suitable() { # the first Python that is new enough and can make an environment
  local name
  for name in python3.14 python3.13 python3.12 python3.11 python3; do
    if "$name" -c 'import ensurepip, sys, venv; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then
      command -v "$name"
      return
    fi
  done
  return 1
}

if ! command -v bwrap >/dev/null || ! suitable >/dev/null; then
  apt-get update -qq
fi
command -v bwrap >/dev/null || apt-get install -qq -y --no-install-recommends bubblewrap ||
  echo "bubblewrap could not be installed"
suitable >/dev/null || apt-get install -qq -y --no-install-recommends python3-venv || true
suitable >/dev/null || apt-get install -qq -y --no-install-recommends python3.11 python3.11-venv || true
python=$(suitable) || { echo "dsim needs Python 3.11 or newer; choose a newer image (Ubuntu 24.04)"; exit 1; }

"$python" -m venv "$home"
"$home/bin/python" -m pip install -q -r "$source/requirements.txt"
chmod -R go+rX "$home"
