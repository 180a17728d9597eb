#include "app/command_line/command_line.h"

#include <CLI/CLI.hpp>
#include <algorithm>
#include <cstdio>
#include <filesystem>
#include <system_error>
#include <utility>

#include "app/command_line/completion.h"
#include "app/command_line/grammar.h"
#include "app/command_line/help.h"
#include "app/json_output.h"
#include "app/version_text.h"
#include "core/error.h"
#include "core/text.h"
#include "plugin/loader.h"
#include "run/run_folder.h"

namespace semfield::app {

namespace {

// The words of a command line but those that name the verb.
struct Split {
  const VerbGrammar* verb = nullptr;  // nullptr: none is named
  std::vector<std::string> rest;
};

// The verb is the first word that is no flag and no flag's value, and of a group the first two; `inspect` where that
// word is a path. Words that stand before it are of every verb.
Split split_words(const Grammar& grammar, const std::vector<std::string>& words) {
  Split split;
  for (std::size_t i = 0; i < words.size(); ++i) {
    const std::string& word = words[i];
    if (split.verb != nullptr && !split.verb->group) {
      split.rest.push_back(word);
      continue;
    }
    const std::string group = split.verb == nullptr ? "" : split.verb->name;
    if (word.empty() || word.front() != '-') {
      split.verb = grammar.find(group.empty() ? word : group + " " + word);
      std::error_code unknown;
      if (split.verb == nullptr && group.empty() && std::filesystem::exists(word, unknown)) {
        split.verb = grammar.find("inspect");  // a scene or a configuration alone asks what it is
        split.rest.push_back(word);
      }
      if (split.verb == nullptr) throw unknown_verb(grammar, group, word);
      continue;
    }
    const auto known = std::find_if(grammar.everywhere.begin(), grammar.everywhere.end(), [&](const Word& w) {
      return word == w.letter || word.substr(0, word.find('=')) == w.name;
    });
    if (known == grammar.everywhere.end()) throw unknown_flag(grammar, group, word);
    split.rest.push_back(word);
    const bool takes_next = !known->value.empty() && word.find('=') == std::string::npos;
    if (takes_next && i + 1 < words.size()) split.rest.push_back(words[++i]);
  }
  return split;
}

// A value that is refused, as the parser's own exceptions are.
void take(const Word& word, const std::string& value) {
  const std::string wrong = word.take(value);
  const std::string name = word.kind == Word::Kind::operand ? word.value : word.name;
  if (!wrong.empty())
    throw Error(ErrorKind::usage, "usage.value.invalid", name + " " + (value.empty() ? "''" : value) + ": " + wrong);
}

void add_word(CLI::App& parser, const Word& word) {
  if (word.kind == Word::Kind::flag) {
    parser.add_flag_callback((word.letter.empty() ? "" : word.letter + ",") + word.name, [&word] { take(word, ""); });
    return;
  }
  const std::string name = word.kind == Word::Kind::operand ? word.value : word.name;
  CLI::Option* option = nullptr;
  if (word.many) {
    option = parser.add_option_function<std::vector<std::string>>(name, [&word](const std::vector<std::string>& all) {
      for (const std::string& value : all) take(word, value);
    });
    if (word.kind == Word::Kind::value) option->expected(1)->take_all()->allow_extra_args(false);
  } else {
    option = parser.add_option_function<std::string>(name, [&word](const std::string& value) { take(word, value); });
  }
  option->required(word.required);
}

void add_words(CLI::App& parser, const std::vector<Word>& words) {
  for (const Word& word : words) {
    if (word.take) add_word(parser, word);
  }
  for (const Word& word : words) {
    for (const std::string& other : word.needs) parser.get_option(word.name)->needs(parser.get_option(other));
    for (const std::string& other : word.excludes) parser.get_option(word.name)->excludes(parser.get_option(other));
  }
}

// A word that is unknown comes before what else is wrong, which often follows from it.
void refuse_unknown(const Grammar& grammar, const VerbGrammar& verb, const std::vector<std::string>& unknown) {
  for (const std::string& word : unknown) {
    if (word.size() > 1 && word.front() == '-') throw unknown_flag(grammar, verb.name, word);
  }
  if (unknown.empty()) return;
  throw Error(ErrorKind::usage, "usage.word.unexpected",
              "unexpected word '" + unknown.front() + "': the usage is `" + usage_of(verb) + "`");
}

// Words left out, and words that exclude each other.
Error refused(const VerbGrammar* verb, const CLI::ParseError& error) {
  const bool no_value = dynamic_cast<const CLI::ArgumentMismatch*>(&error) != nullptr;
  const std::string text = error.what(), name = verb == nullptr ? "" : " " + verb->name;
  return {ErrorKind::usage, "usage.word.missing",
          (verb == nullptr ? "" : verb->name + ": ") +
              (no_value ? text.substr(0, text.find(':')) + ": its value is missing" : text),
          "see " + command("help" + name)};
}

int print_help(const Grammar& grammar, const VerbGrammar* verb) {
  std::fputs((verb != nullptr ? verb_help(grammar, *verb) : program_help(grammar)).c_str(), stdout);
  return 0;
}

void print_version(const Split& split, AppContext& context) {
  if (std::find(split.rest.begin(), split.rest.end(), "--json") == split.rest.end()) {
    std::fputs(version_lines().c_str(), stdout);
  } else {
    context.verb = "version";
    print_json(context, Json::parse(environment_json(this_environment())));
  }
}

// Reads the words of `split` into what they take; true: all was done by it.
bool parse(const Grammar& grammar, const Split& split, AppContext& context) {
  CLI::App parser;
  parser.set_help_flag("-h,--help");
  parser.set_version_flag("--version", [] { return std::string(); });
  add_words(parser, grammar.everywhere);
  if (split.verb != nullptr) add_words(parser, split.verb->words);
  try {
    std::vector<std::string> last_first(split.rest.rbegin(), split.rest.rend());
    parser.parse(last_first);
  } catch (const CLI::CallForHelp&) {
    print_help(grammar, split.verb);
    return true;
  } catch (const CLI::CallForVersion&) {
    print_version(split, context);
    return true;
  } catch (const CLI::ParseError& error) {
    if (split.verb != nullptr) refuse_unknown(grammar, *split.verb, parser.remaining());
    throw refused(split.verb, error);
  } catch (const Error&) {
    if (split.verb != nullptr) refuse_unknown(grammar, *split.verb, parser.remaining());
    throw;
  }
  return false;
}

}  // namespace

int run_command_line(int argc, char** argv, AppContext& context) {
  if (argc > 2 && argv[1] == std::string("completion") && argv[2] == std::string("--of")) {  // unparsed: half a line
    std::fputs(completions(program_grammar(), {argv + 3, argv + argc}).c_str(), stdout);
    return 0;
  }
  GlobalOptions global;
  const Grammar grammar = program_grammar(global);
  const Split split = split_words(grammar, {argv + 1, argv + argc});
  if (parse(grammar, split, context)) return 0;
  context.quiet = global.quiet;
  context.json = global.json;
  if (split.verb == nullptr || split.verb->group) {
    // Nothing was done, and a script whose verb got lost should not go on as if something had been.
    print_help(grammar, split.verb);
    return static_cast<int>(ErrorKind::usage);
  }
  context.verb = split.verb->name;
  if (context.json && !split.verb->json) throw no_json(grammar, *split.verb);
  Diagnostics of_checks;
  for (const std::string& module : global.modules) load_module(context.registry, module, {true, &of_checks});
  for (const Diagnostic& note : of_checks.all()) print_note(context, note.shown());
  std::vector<std::string> words;
  for (int i = 1; i < argc; ++i) words.push_back(shell_word(argv[i]));
  return run_launched({split.verb->name, split.verb->launch, split.verb->run, join(words, " ")}, context);
}

}  // namespace semfield::app
