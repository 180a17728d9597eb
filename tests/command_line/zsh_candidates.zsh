# zsh_candidates.zsh SCRIPT WORDS: what zsh offers where the words end, a line each. The completion runs in an interactive zsh of its own.
emulate -L zsh
zmodload zsh/zpty || exit 1
zpty z zsh -f -i
local line prepare
prepare=(
  "PROMPT=; PROMPT2=; setopt no_beep"
  "autoload -Uz compinit && compinit -u -D"
  "source ${(q)1}"
  # Whatever would be added is printed instead.
  'compadd() { local -a found; local -i i=${@[(I)-O|-A|-D]}; if (( i )) { builtin compadd "$@"; return $? }; builtin compadd -A found "$@"; (( $#found )) && print -rl -- "<"${^found}">"; builtin compadd "$@" }'
  "bindkey '^I' complete-word"
  'print READY'
)
for line in $prepare; zpty -w z $line
while zpty -r z line; do [[ $line == *READY$'\r\n' && $line != *print* ]] && break; done
zpty -n -w z "$2"$'\t'
sleep 0.2
zpty -n -w z $'\C-u'
zpty -w z 'print THE-END'
while zpty -r z line; do
  [[ $line == *THE-END$'\r\n' && $line != *print* ]] && break
  print -r -- ${line//$'\r'/}
done | grep -o '<[^<>]*>$' | tr -d '<>' | sort -u
zpty -d z
