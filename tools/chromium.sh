#!/usr/bin/env bash
# Install Chromium and its driver, with which the test of the live view clicks. Debian's and
# Ubuntu's packages, as root; elsewhere nothing happens and that test is skipped.
set -euo pipefail

command -v chromium >/dev/null && command -v chromedriver >/dev/null && exit 0
if [ "$(id -u)" != 0 ] || ! command -v apt-get >/dev/null; then
  echo 'chromium: neither there nor installable (root and apt-get): its test is skipped'
  exit 0
fi
export DEBIAN_FRONTEND=noninteractive
if ! timeout 300 apt-get -qq update || ! timeout 300 apt-get -qq install -y \
  --no-install-recommends chromium chromium-driver >/dev/null; then
  echo 'chromium: cannot be installed: its test is skipped'
fi
