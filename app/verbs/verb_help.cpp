// help and completion: the words of the program, of a group or of a verb, on the terminal, as pages, and in shells.
#include <cstdio>
#include <filesystem>

#include "app/command_line.h"
#include "app/verb.h"
#include "core/error.h"
#include "plugin/reference.h"
#include "session/settings/run_config.h"
#include "system/files.h"

namespace semfield::app {

namespace {

struct HelpOptions : Options {
  explicit HelpOptions(const Declaration& at) : Options(at) { excludes("--pages", "VERB"); }
  const std::vector<std::string>& verb =
      operands("[verb]", "verb, such as: train, config check (default: the list of all verbs)", words_of_verbs());
  const std::string& pages =
      value("--pages FOLDER",
            "copy of the pages of the source tree, in which those about verbs, plugins and keys are written");
};

// Tables of every section of a configuration, under headings of their own.
std::string section_tables() {
  std::string text;
  for (const SchemaSection& section : describe_sections())
    text +=
        "### `" + section.path + "`: " + section.sentence + "\n\n" + parameter_table_markdown(section.params) + "\n";
  return text;
}

// Pages of the program's own words: verbs and plugins whole, and tables where a page has their mark.
void write_pages(const fs::path& root, const AppContext& context) {
  if (!fs::is_directory(root / "plugins"))
    throw Error(ErrorKind::no_input, "files.folder.missing", "--pages " + root.string() + ": it has no folder plugins",
                "name a copy of the pages of the source tree");
  const fs::path reference = root / "docs" / "reference";
  fs::create_directories(reference);
  write_file_atomic((reference / "plugins.md").string(), plugins_markdown(context.registry));
  write_file_atomic((reference / "verbs.md").string(), verbs_page());
  int filled = 0;
  const auto fill = [&filled](const fs::path& path, const std::string& mark, const std::string& part) {
    std::string text = fs::exists(path) ? read_text_file(path.string()) : "";
    const std::size_t at = text.find(mark);
    if (at == std::string::npos) return;
    write_file_atomic(path.string(), text.replace(at, mark.size(), part));
    ++filled;
  };
  fill(reference / "configuration.md", "<!-- sections -->\n", section_tables());
  for (const PluginEntry* entry : context.registry.entries()) {
    for (const char* tree : {"framework", "plugins"})
      fill(root / tree / kind_folder(entry->kind) / entry->name / "README.md", "<!-- parameters -->\n",
           parameter_table_markdown(*entry));
  }
  print_note(context,
             "verbs.md and plugins.md written, " + std::to_string(filled) + " tables filled under " + root.string());
}

int run(const HelpOptions& options, AppContext& context) {
  if (options.pages.empty()) {
    std::fputs(help_of(options.verb).c_str(), stdout);
  } else {
    write_pages(options.pages, context);
  }
  return 0;
}

// What shells read. It runs the program at each TAB: `semfield completion --of WORDS`.

struct CompletionOptions : Options {
  using Options::Options;
  const std::string& shell = operand("shell", "bash or zsh", {"bash", "zsh"});
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

int run(const CompletionOptions& options, AppContext&) {
  std::fputs(options.shell == "bash" ? kBash : kZsh, stdout);
  return 0;
}

}  // namespace

Verb verb_help() { return without_json(make_verb<HelpOptions>("help", 210, "print the usage of a verb", run)); }

Verb verb_completion() {
  return without_json(make_verb<CompletionOptions>("completion", 220,
                                                   "print a script that completes verbs and options in a shell", run));
}

}  // namespace semfield::app
