#include "app/command_line/command_line.h"

#include <fmt/format.h>

#include <CLI/CLI.hpp>
#include <algorithm>
#include <charconv>
#include <cmath>
#include <cstdio>
#include <filesystem>
#include <optional>
#include <set>
#include <system_error>
#include <tuple>
#include <type_traits>
#include <utility>

#include "app/app_context.h"
#include "app/command_line/completion.h"
#include "app/command_line/help.h"
#include "app/json_output.h"
#include "app/verb.h"
#include "core/check.h"
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

namespace {

// A group stands before its verbs, and these by their own ranks.
std::vector<Verb> ordered_verbs() {
  std::vector<Verb> verbs = all_verbs();
  const std::vector<Verb> unordered = verbs;
  const auto rank_of_top = [&](const std::string& name) {
    const auto top = std::find_if(unordered.begin(), unordered.end(),
                                  [&](const Verb& verb) { return verb.name == name.substr(0, name.find(' ')); });
    return top == unordered.end() ? 0 : top->rank;
  };
  std::sort(verbs.begin(), verbs.end(), [&](const Verb& a, const Verb& b) {
    const auto key = [&](const Verb& verb) {
      const bool below = verb.name.find(' ') != std::string::npos;
      return std::make_tuple(rank_of_top(verb.name), verb.name.substr(0, verb.name.find(' ')), below, verb.rank,
                             std::cref(verb.name));
    };
    return key(a) < key(b);
  });
  return verbs;
}

Word word_of_all(Word::Kind kind, std::string name, std::string letter, std::string value, std::string help) {
  Word word;
  word.kind = kind;
  word.name = std::move(name);
  word.letter = std::move(letter);
  word.value = std::move(value);
  word.help = std::move(help);
  return word;
}

std::vector<Word> words_everywhere(GlobalOptions& global) {
  Word quiet = word_of_all(Word::Kind::flag, "--quiet", "-q", "", "print no progress and no notes");
  quiet.take = [&global](const std::string&) {
    global.quiet = true;
    return std::string();
  };
  Word json = word_of_all(Word::Kind::flag, "--json", "", "",
                          "print the results as one JSON object on stdout, if the verb has any");
  json.take = [&global](const std::string&) {
    global.json = true;
    return std::string();
  };
  Word plugin = word_of_all(Word::Kind::value, "--plugin", "", "FILE", "load a plugin module first");
  plugin.many = true;
  plugin.take = [&global](const std::string& value) {
    global.modules.push_back(value);
    return std::string();
  };
  // The parser itself knows what these two do.
  Word help = word_of_all(Word::Kind::flag, "--help", "-h", "", "print this help");
  Word version = word_of_all(Word::Kind::flag, "--version", "", "",
                             "print version, compiler, plugin interface and instruction sets");
  return {std::move(quiet), std::move(json), std::move(plugin), std::move(help), std::move(version)};
}

}  // namespace

std::string VerbGrammar::parent() const { return name.substr(0, std::max<std::size_t>(name.find(' ') + 1, 1) - 1); }
std::string VerbGrammar::last() const { return name.substr(name.find(' ') + 1); }

std::vector<const Word*> VerbGrammar::operands() const {
  std::vector<const Word*> out;
  for (const Word& word : words) {
    if (word.kind == Word::Kind::operand) out.push_back(&word);
  }
  return out;
}

const VerbGrammar* Grammar::find(const std::string& name) const {
  const auto found = std::find_if(verbs.begin(), verbs.end(), [&](const VerbGrammar& v) { return v.name == name; });
  return found == verbs.end() ? nullptr : &*found;
}

std::vector<const VerbGrammar*> Grammar::below(const std::string& group) const {
  std::vector<const VerbGrammar*> out;
  for (const VerbGrammar& verb : verbs) {
    if (verb.parent() == group) out.push_back(&verb);
  }
  return out;
}

std::vector<const Word*> Grammar::words_of(const VerbGrammar& verb) const {
  std::vector<const Word*> out;
  for (const Word& word : verb.words) out.push_back(&word);
  for (const Word& word : everywhere) {
    if (word.name != "--version" && (word.name != "--json" || verb.json)) out.push_back(&word);
  }
  return out;
}

std::vector<const Word*> Grammar::options_of(const VerbGrammar* verb) const {
  std::vector<const Word*> out;
  if (verb == nullptr) {
    for (const Word& word : everywhere) out.push_back(&word);
  } else {
    for (const Word* word : words_of(*verb)) {
      if (word->kind != Word::Kind::operand) out.push_back(word);
    }
  }
  return out;
}

Grammar program_grammar(GlobalOptions& global) {
  Grammar grammar;
  grammar.everywhere = words_everywhere(global);
  for (const Verb& verb : ordered_verbs()) {
    VerbGrammar made;
    made.name = verb.name;
    made.sentence = verb.sentence;
    made.group = !verb.declare;
    made.json = verb.json;
    made.launch = verb.launch;
    if (verb.declare) {
      VerbWords words(made);
      made.run = verb.declare(words);
    }
    grammar.verbs.push_back(std::move(made));
  }
  return grammar;
}

const Grammar& program_grammar() {
  static GlobalOptions nobody;
  static const Grammar grammar = program_grammar(nobody);
  return grammar;
}

std::string one_of(const std::vector<std::string>& words) {
  if (words.size() < 2) return join(words);
  return join(std::vector<std::string>(words.begin(), words.end() - 1)) + " or " + words.back();
}

std::string sentence_of(const Word& word) {
  std::vector<std::string> facts;
  if (!word.range.empty()) facts.push_back(word.range);
  const bool says_default = word.help.find("(default: ") != std::string::npos;
  if (!word.initial.empty() && !says_default) facts.push_back("default: " + word.initial);
  if (word.required && word.kind == Word::Kind::value) facts.push_back("required");
  return word.help + (facts.empty() ? "" : " (" + join(facts, "; ") + ")");
}

std::string form_of(const Word& word) {
  if (word.kind == Word::Kind::operand) {
    const std::string name = word.value + (word.many ? "..." : "");
    return word.required ? name : "[" + name + "]";
  }
  return (word.letter.empty() ? "" : word.letter + ", ") + word.name + (word.value.empty() ? "" : " " + word.value);
}

std::string command(const std::string& words) { return "`" + program_name() + " " + words + "`"; }

std::string usage_of(const VerbGrammar& verb) {
  std::string text = program_name() + " " + verb.name;
  if (verb.group) return text + " VERB";
  bool options = false;
  for (const Word& word : verb.words) {
    options = options || word.kind != Word::Kind::operand;
    if (word.kind == Word::Kind::operand || word.required) text += " " + form_of(word);
  }
  return text + (options ? " [OPTIONS]" : "");
}

ValueFiles files_of(const Word& word) {
  for (const char* name : {"FILE", "PATH", "CONFIG", "TABLE", "PAGE", "PROGRAM"}) {  // "CONFIG_A" too
    if (word.value.starts_with(name)) return ValueFiles::files;
  }
  for (const char* name : {"FOLDER", "RUN"}) {
    if (word.value.starts_with(name)) return ValueFiles::folders;
  }
  return ValueFiles::none;
}

// Words of verbs as they are declared: how each takes a value, and what it says about one that it does not take.

namespace {

template <class T>
struct Plain {
  using type = T;
  static std::string initial(const T& value) { return fmt::format("{}", value); }
};
template <class T>
struct Plain<std::optional<T>> {
  using type = T;
  static std::string initial(const std::optional<T>&) { return ""; }
};

bool read_number(const std::string& text, double& into) { return parse_number(text, into); }
bool read_number(const std::string& text, long long& into) {
  const char* end = text.data() + text.size();
  const std::from_chars_result read = std::from_chars(text.data(), end, into);
  return read.ec == std::errc{} && read.ptr == end;
}

std::string not_one_of(const std::string& value, const std::vector<std::string>& choices) {
  if (std::find(choices.begin(), choices.end(), value) != choices.end()) return "";
  const std::string near = did_you_mean(value, choices);
  return "expected " + one_of(choices) + (near.empty() ? "" : "; did you mean " + near + "?");
}

std::string upper(std::string text) {
  for (char& c : text) c = static_cast<char>(c >= 'a' && c <= 'z' ? c - 'a' + 'A' : c);
  return text;
}

Word operand_word(const std::string& name, const std::string& help) {
  Word word;
  word.kind = Word::Kind::operand;
  word.name = name;
  word.value = upper(name);
  word.help = help;
  return word;
}

std::function<std::string(const std::string&)> into_text(std::string& into) {
  return [&into](const std::string& value) {
    into = value;
    return std::string();
  };
}

std::function<std::string(const std::string&)> into_list(std::vector<std::string>& into) {
  return [&into](const std::string& value) {
    into.push_back(value);
    return std::string();
  };
}

}  // namespace

// Names alone: what verbs declare may name all verbs.
std::vector<std::string> words_of_verbs() {
  std::set<std::string> words;
  for (const Verb& verb : all_verbs()) {
    for (const std::string_view word : words_of(verb.name)) words.emplace(word);
  }
  return {words.begin(), words.end()};
}

Word& VerbWords::add(Word word) {
  SEMFIELD_CHECK(!word.help.empty(), "a word without a sentence");
  verb_.words.push_back(std::move(word));
  return verb_.words.back();
}

Word& VerbWords::option(const std::string& name, const char* usual_value, const std::string& help) {
  Word word;
  const std::size_t blank = name.find(' ');
  word.kind = Word::Kind::value;
  word.name = name.substr(0, blank);
  word.value = blank == std::string::npos ? usual_value : name.substr(blank + 1);
  word.help = help;
  return add(std::move(word));
}

Word& VerbWords::known(const std::string& name) {
  const auto found =
      std::find_if(verb_.words.begin(), verb_.words.end(), [&](const Word& word) { return word.name == name; });
  SEMFIELD_CHECK(found != verb_.words.end(), "a word that is not declared before");
  return *found;
}

void VerbWords::operand(const std::string& name, std::string& into, const std::string& help,
                        std::vector<std::string> choices) {
  Word& word = add(operand_word(name, help));
  word.required = true;
  word.take = [&into, choices](const std::string& value) {
    into = value;
    return choices.empty() ? std::string() : not_one_of(value, choices);
  };
  word.choices = std::move(choices);
}

void VerbWords::optional_operand(const std::string& name, std::string& into, const std::string& help) {
  add(operand_word(name, help)).take = into_text(into);
}

void VerbWords::operands(const std::string& name, std::vector<std::string>& into, const std::string& help) {
  optional_operands(name, into, help);
  verb_.words.back().required = true;
}

void VerbWords::optional_operands(const std::string& name, std::vector<std::string>& into, const std::string& help,
                                  std::vector<std::string> offered) {
  Word& word = add(operand_word(name, help));
  word.many = true;
  word.choices = std::move(offered);
  word.take = into_list(into);
}

void VerbWords::flag(const std::string& name, bool& into, const std::string& help) {
  Word word;
  word.name = name;
  word.help = help;
  add(std::move(word)).take = [&into](const std::string&) {
    into = true;
    return std::string();
  };
}

void VerbWords::value(const std::string& name, std::string& into, const std::string& help,
                      std::vector<std::string> offered) {
  Word& word = option(name, "VALUE", help);
  word.choices = std::move(offered);
  word.initial = into;
  word.take = into_text(into);
}

template <class T>
void VerbWords::value_in(const std::string& name, T& into, double low, double high, const std::string& help) {
  using Number = typename Plain<T>::type;
  using Read = std::conditional_t<std::is_floating_point_v<Number>, double, long long>;
  Word& word = option(name, std::is_floating_point_v<Number> ? "X" : "N", help);
  word.range = fmt::format("{} to {}", static_cast<Read>(low), static_cast<Read>(high));
  word.initial = Plain<T>::initial(into);
  word.take = [&into, low, high, range = word.range](const std::string& text) {
    Read value = 0;
    // NaN is in no range.
    if (!read_number(text, value) || !(static_cast<double>(value) >= low && static_cast<double>(value) <= high)) {
      return "expected " + range;
    }
    into = static_cast<Number>(value);
    return std::string();
  };
}
template void VerbWords::value_in(const std::string&, int&, double, double, const std::string&);
template void VerbWords::value_in(const std::string&, long long&, double, double, const std::string&);
template void VerbWords::value_in(const std::string&, double&, double, double, const std::string&);
template void VerbWords::value_in(const std::string&, std::optional<int>&, double, double, const std::string&);
template void VerbWords::value_in(const std::string&, std::optional<long long>&, double, double, const std::string&);
template void VerbWords::value_in(const std::string&, std::optional<double>&, double, double, const std::string&);

template <class T>
void VerbWords::positive(const std::string& name, T& into, const std::string& help) {
  Word& word = option(name, "X", help);
  word.range = "more than 0";
  word.initial = Plain<T>::initial(into);
  word.take = [&into](const std::string& text) {
    double value = 0;
    if (!read_number(text, value) || !(value > 0 && std::isfinite(value))) {
      return std::string("expected a positive number");
    }
    into = value;
    return std::string();
  };
}
template void VerbWords::positive(const std::string&, double&, const std::string&);
template void VerbWords::positive(const std::string&, std::optional<double>&, const std::string&);

void VerbWords::choice(const std::string& name, std::string& into, const std::vector<std::string>& choices,
                       const std::string& help) {
  Word& word = option(name, "WORD", help);
  word.choices = choices;
  word.initial = into;
  word.take = [&into, choices](const std::string& value) {
    into = value;
    return not_one_of(value, choices);
  };
}

void VerbWords::required(const std::string& name, std::string& into, const std::string& help) {
  value(name, into, help);
  verb_.words.back().required = true;
}

void VerbWords::repeated(const std::string& name, std::vector<std::string>& into, const std::string& help) {
  Word& word = option(name, "VALUE", help);
  word.many = true;
  word.take = into_list(into);
}

void VerbWords::list(const std::string& name, std::vector<std::string>& into, const std::string& help,
                     const std::vector<std::string>& choices) {
  Word& word = option(name, "LIST", help);
  word.many = word.commas = true;
  word.choices = choices;
  word.take = [&into, choices](const std::string& value) {
    for (std::size_t at = 0; at <= value.size();) {
      const std::size_t comma = std::min(value.find(',', at), value.size());
      into.push_back(value.substr(at, comma - at));
      if (into.back().empty()) return std::string("an item between the commas is empty");
      if (std::string wrong = choices.empty() ? "" : not_one_of(into.back(), choices); !wrong.empty()) return wrong;
      at = comma + 1;
    }
    return std::string();
  };
}

void VerbWords::setting(std::vector<std::string>& set, const std::string& name, const std::string& key,
                        const std::string& help, std::vector<std::string> offered) {
  Word& word = option(name, "VALUE", help);
  word.choices = std::move(offered);
  word.take = [&set, option = word.name, key](const std::string& value) {
    set.push_back(option + " " + key + "=" + value);
    return std::string();
  };
}

void VerbWords::threads(std::vector<std::string>& set) {
  setting(set, "--threads N", "runtime.threads", "CPU threads; results do not depend on it (default: runtime.threads)");
}

void VerbWords::device(std::vector<std::string>& set) {
  setting(set, "--device DEVICE", "runtime.device", "auto, cpu, cuda or cuda:N (default: runtime.device)",
          {"auto", "cpu", "cuda"});
}

void VerbWords::config(ConfigOptions& options) {
  operand("config", options.config, "configuration file (YAML)");
  repeated("--set KEY=VALUE", options.set, "override a value: --set train.rays=2048");
}

void VerbWords::run_settings(std::vector<std::string>& set) {
  repeated("--set KEY=VALUE", set, "override a value of run.yaml");
  threads(set);
}

void VerbWords::needs(const std::string& name, const std::string& other) {
  known(name).needs.push_back(known(other).name);
}

void VerbWords::excludes(const std::string& name, const std::string& other) {
  known(name).excludes.push_back(known(other).name);
}

}  // namespace semfield::app
