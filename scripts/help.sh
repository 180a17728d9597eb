# Sourced by the scripts before they change folder: script_words MOST "$@" prints the comment at the script's top for -h and --help, and
# refuses more than MOST words, and flags that are not among $script_flags, which take a value each, with exit code 2. MOST may be `many`, or
# `any` where flags belong to somebody else.
script_words() {
  local most=$1 word name
  shift
  name=$(basename "$0")
  for word in "$@"; do
    if [ "$word" = -h ] || [ "$word" = --help ]; then
      awk 'NR > 1 { if (!/^#/) exit; sub(/^# ?/, ""); print }' "$0"
      exit 0
    fi
  done
  [ "$most" != any ] || return 0
  while [ $# -gt 0 ]; do
    if [[ $1 == -* ]]; then
      if [[ " ${script_flags:-} " != *" ${1%%=*} "* ]]; then
        echo "$name: unknown option '$1'; \`scripts/$name --help\` tells what it takes" >&2
        exit 2
      fi
      [[ $1 == *=* || $# -eq 1 ]] || shift
    elif [ "$most" != many ] && [ $((most -= 1)) -lt 0 ]; then
      echo "$name: unexpected word '$1'; \`scripts/$name --help\` tells what it takes" >&2
      exit 2
    fi
    shift
  done
}
