// The script for bash. It needs nothing but bash: the package bash-completion only finds and loads it.
#include "app/command_line/completion.h"
#include "core/error.h"

namespace semfield::app {

namespace {

constexpr const char* kHead = R"(# bash completion of semfield, made by `semfield completion bash`

# Words, after what stands before the last comma of a list.
_semfield_words() { mapfile -t COMPREPLY < <(compgen -P "$2" -W "$1" -- "${cur#"$2"}"); }
_semfield_list() {
  local done=${cur%"${cur##*,}"}
  compopt -o nospace 2>/dev/null
  _semfield_words "$1" "$done"
}
_semfield_files() {
  compopt -o filenames 2>/dev/null
  mapfile -t -O ${#COMPREPLY[@]} COMPREPLY < <(compgen -f -- "$cur")
}
_semfield_folders() {
  compopt -o filenames 2>/dev/null
  mapfile -t -O ${#COMPREPLY[@]} COMPREPLY < <(compgen -d -- "$cur")
}

_semfield() {
  local cur=${COMP_WORDS[COMP_CWORD]} prev=${COMP_WORDS[COMP_CWORD - 1]} verb= word i flags= operands=0
  COMPREPLY=()
  # Bash cuts --split=test into three words.
  if [[ $cur == = ]]; then
    cur=
  elif [[ $prev == = ]]; then
    prev=${COMP_WORDS[COMP_CWORD - 2]}
  fi
  for ((i = 1; i < COMP_CWORD; i++)); do
    word=${COMP_WORDS[i]}
    case "$verb:$word" in
)";

std::string case_of(const std::string& pattern, const std::string& action) {
  return "        " + pattern + ") " + action + " ;;\n";
}

// What completes a value; "" for one that nothing is known about.
std::string value_action(const Word& word) {
  const std::string words = join(word.choices, " ");
  if (word.commas && !words.empty()) return "_semfield_list '" + words + "'";
  std::string action = words.empty() ? "" : "_semfield_words '" + words + "'";
  const char* files = files_of(word) == ValueFiles::files     ? "_semfield_files"
                      : files_of(word) == ValueFiles::folders ? "_semfield_folders"
                                                              : "";
  if (*files != '\0') action += (action.empty() ? "" : "; ") + std::string(files);
  return action.empty() ? ":" : action;
}

// A flag's names as patterns of `case`.
std::string names(const Word& word, const char* between) {
  return (word.letter.empty() ? "" : word.letter + between) + word.name;
}

std::string verb_case(const Grammar& grammar, const VerbGrammar* verb) {
  const std::string name = verb == nullptr ? "" : verb->name;
  std::string text = "    '" + name + "')\n";
  std::string values, flags;
  for (const Word* word : grammar.options_of(verb)) {
    flags += (flags.empty() ? "" : " ") + names(*word, " ");
    if (!word->value.empty()) values += case_of(names(*word, " | "), value_action(*word) + "; return");
  }
  if (!values.empty()) text += "      case $prev in\n" + values + "      esac\n";
  text += "      flags='" + flags + "'\n";
  if (verb == nullptr || verb->group) {
    std::vector<std::string> below;
    for (const VerbGrammar* other : grammar.below(name)) below.push_back(other->last());
    return text + "      [[ $cur == -* ]] || { _semfield_words '" + join(below, " ") + "'; return; }\n      ;;\n";
  }
  const std::vector<const Word*> operands = verb->operands();
  if (operands.empty()) return text + "      ;;\n";
  text += "      [[ $cur == -* ]] || case $operands in\n";
  for (std::size_t i = 0; i < operands.size(); ++i) {
    const bool rest = i + 1 == operands.size() && operands[i]->many;
    text += case_of(rest ? "*" : std::to_string(i), value_action(*operands[i]) + "; return");
  }
  return text + "      esac\n      ;;\n";
}

}  // namespace

std::string bash_completion(const Grammar& grammar) {
  std::string text = kHead;
  // Which verb is named, and how many operands stand before the cursor.
  for (const VerbGrammar& verb : grammar.verbs)
    text += "      '" + verb.parent() + ":" + verb.last() + "') verb='" + verb.name + "' ;;\n";
  std::vector<std::string> with_value;
  for (const VerbGrammar& verb : grammar.verbs) {
    for (const Word& word : verb.words) {
      if (word.kind == Word::Kind::value) with_value.push_back("'" + verb.name + ":" + word.name + "'");
    }
  }
  for (const Word& word : grammar.everywhere) {
    if (word.kind == Word::Kind::value) with_value.push_back("*:" + word.name);
  }
  text += "      " + join(with_value, " | ") +
          ")\n"
          "        [[ ${COMP_WORDS[i + 1]} != = ]] || i=$((i + 1))\n"
          "        i=$((i + 1))\n"
          "        ;;\n"
          "      *:-*) ;;\n"
          "      *) operands=$((operands + 1)) ;;\n"
          "    esac\n"
          "  done\n"
          "  case $verb in\n";
  text += verb_case(grammar, nullptr);
  for (const VerbGrammar& verb : grammar.verbs) text += verb_case(grammar, &verb);
  return text +
         "  esac\n"
         "  _semfield_words \"$flags\"\n"
         "}\n"
         "complete -F _semfield semfield\n";
}

}  // namespace semfield::app
