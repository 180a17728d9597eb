#include "app/command_line/completion.h"

#include <algorithm>
#include <optional>

#include "core/error.h"

namespace semfield::app {

namespace {

// The words before the cursor, as far as they matter for what comes next.
struct Typed {
  const VerbGrammar* verb = nullptr;
  std::size_t operands = 0;
  const Word* option = nullptr;  // whose value comes next
};

const Word* option_named(const Grammar& grammar, const VerbGrammar* verb, const std::string& name) {
  for (const Word* word : grammar.options_of(verb)) {
    if (word->name == name || word->letter == name) return word;
  }
  return nullptr;
}

Typed typed_before(const Grammar& grammar, const std::vector<std::string>& words) {
  Typed typed;
  for (std::size_t i = 0; i + 1 < words.size(); ++i) {
    const std::string& word = words[i];
    if (word == "=") continue;
    if (typed.option != nullptr) {
      typed.option = nullptr;
    } else if (word.starts_with('-')) {
      const Word* option = option_named(grammar, typed.verb, word);
      if (option != nullptr && !option->value.empty()) typed.option = option;
    } else if (typed.verb == nullptr || typed.verb->group) {
      typed.verb = grammar.find(typed.verb == nullptr ? word : typed.verb->name + " " + word);
      if (typed.verb == nullptr) break;
    } else {
      ++typed.operands;
    }
  }
  return typed;
}

class Offer {
 public:
  // Candidates begin with `head`, which is there already; `rest` is what was typed behind it.
  Offer(std::string head, std::string rest) : head_(std::move(head)), rest_(std::move(rest)) {}

  void add(const std::string& word, const std::string& sentence = "") {
    if (word.starts_with(rest_)) lines_ += head_ + word + "\t" + sentence + "\n";
  }
  // What completes a value or an operand.
  void add_values(const Word& word) {
    if (word.commas && !word.choices.empty()) {
      kind_ = "list";
      const std::size_t items = rest_.rfind(',') + 1;
      head_ += rest_.substr(0, items);
      rest_.erase(0, items);
    } else if (const ValueFiles files = files_of(word); files != ValueFiles::none) {
      kind_ = files == ValueFiles::files ? "files" : "folders";
    }
    for (const std::string& choice : word.choices) add(choice);
  }
  std::string text() const { return kind_ + "\n" + lines_; }

 private:
  std::string head_, rest_, kind_ = "words", lines_;
};

constexpr const char* kBash = R"(# bash completion of semfield, made by `semfield completion bash`
_semfield() {
  local kind word rest
  COMPREPLY=()
  {
    read -r kind
    while IFS=$'\t' read -r word rest; do COMPREPLY+=("$word"); done
  } < <("${COMP_WORDS[0]}" completion --of "${COMP_WORDS[@]:1:COMP_CWORD}" 2>/dev/null)
  local cur=${COMP_WORDS[COMP_CWORD]}
  [[ $cur != = ]] || cur=
  case $kind in
    files) compopt -o filenames 2>/dev/null; mapfile -t -O ${#COMPREPLY[@]} COMPREPLY < <(compgen -f -- "$cur") ;;
    folders) compopt -o filenames 2>/dev/null; mapfile -t -O ${#COMPREPLY[@]} COMPREPLY < <(compgen -d -- "$cur") ;;
    list) compopt -o nospace 2>/dev/null ;;
  esac
}
complete -F _semfield semfield
)";

constexpr const char* kZsh = R"(#compdef semfield
# zsh completion of semfield, made by `semfield completion zsh`
_semfield() {
  local -a lines values shown end
  local line kind
  lines=("${(@f)$($words[1] completion --of "${(@)words[2,CURRENT]}" 2>/dev/null)}")
  kind=$lines[1]
  for line in ${lines[2,-1]}; do
    values+=("${line%%$'\t'*}")
    shown+=("${line%%$'\t'*}${${line#*$'\t'}:+  -- ${line#*$'\t'}}")
  done
  [[ $kind != list ]] || end=(-S '')
  (( $#values )) && compadd $end -l -d shown -- $values
  [[ $kind != (files|folders) ]] || compset -P '--*='
  case $kind in
    files) _files ;;
    folders) _files -/ ;;
  esac
}
# Loaded from a folder of functions it completes at once; read by `source` it makes itself known.
if [[ $funcstack[1] == _semfield ]]; then
  _semfield "$@"
else
  compdef _semfield semfield
fi
)";

constexpr const char* kFish = R"(# fish completion of semfield, made by `semfield completion fish`
function __semfield_offer
  set -l words (commandline -opc)
  set -l lines ($words[1] completion --of $words[2..-1] (commandline -ct) 2>/dev/null)
  printf '%s\n' $lines[2..-1]
  set -l value (string replace -r '^--[a-z-]+=' '' -- (commandline -ct))
  switch $lines[1]
    case files
      __fish_complete_path $value
    case folders
      __fish_complete_directories $value
  end
end
complete -c semfield -f -a '(__semfield_offer)'
)";

}  // namespace

std::string completions(const Grammar& grammar, const std::vector<std::string>& words) {
  std::string current = words.empty() || words.back() == "=" ? "" : words.back();
  Typed typed = typed_before(grammar, words);
  std::string head;
  if (const std::size_t equals = current.find('='); current.starts_with("--") && equals != std::string::npos) {
    typed.option = option_named(grammar, typed.verb, current.substr(0, equals));
    head = current.substr(0, equals + 1);
    current.erase(0, equals + 1);
  }
  const bool flag = current.starts_with('-');
  Offer offer(head, current);
  if (typed.option != nullptr) {
    offer.add_values(*typed.option);
  } else if (!head.empty()) {
    return offer.text();
  } else if (!flag && (typed.verb == nullptr || typed.verb->group)) {
    for (const VerbGrammar* verb : grammar.below(typed.verb == nullptr ? "" : typed.verb->name))
      offer.add(verb->last(), verb->sentence);
  } else {
    const std::vector<const Word*> operands =
        typed.verb == nullptr ? decltype(typed.verb->operands())() : typed.verb->operands();
    const Word* next = typed.operands < operands.size()             ? operands[typed.operands]
                       : !operands.empty() && operands.back()->many ? operands.back()
                                                                    : nullptr;
    if (!flag && next != nullptr) {
      offer.add_values(*next);
    } else {
      for (const Word* word : grammar.options_of(typed.verb)) {
        if (!word->letter.empty()) offer.add(word->letter, sentence_of(*word));
        offer.add(word->name, sentence_of(*word));
      }
    }
  }
  return offer.text();
}

const std::vector<std::string>& shells() {
  static const std::vector<std::string> names{"bash", "zsh", "fish"};
  return names;
}

std::string completion_script(const std::string& shell) {
  return shell == "bash" ? kBash : shell == "zsh" ? kZsh : kFish;
}

}  // namespace semfield::app
