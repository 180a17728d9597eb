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
#include "app/signals.h"
#include "app/terminal.h"
#include "app/verb.h"
#include "compute/isa.h"
#include "core/error.h"
#include "core/files.h"
#include "core/text.h"
#include "execution/ranks/ranks.h"
#include "plugin/loader.h"
#include "plugin/module.h"
#include "train/run_folder.h"
#include "train/session.h"

namespace semfield::app {

// Words of verbs as they are declared.

namespace {

CLI::Validator number_that(const std::string& what, const std::function<bool(double)>& good) {
  return {[what, good](std::string& text) {
            double value = 0;
            return parse_number(text, value) && good(value) ? std::string() : "'" + text + "' is not " + what;
          },
          what};
}

// A transform, not a check: CLI11 would read 010 as an octal number.
CLI::Validator whole_number_in(const std::string& range, double low, double high) {
  return {[range, low, high](std::string& text) {
            long long value = 0;
            const bool plus = text.size() > 1 && text[0] == '+' && text[1] != '-';
            const char* end = text.data() + text.size();
            const std::from_chars_result read = std::from_chars(text.data() + (plus ? 1 : 0), end, value);
            const auto real = static_cast<double>(value);
            if (read.ec != std::errc{} || read.ptr != end || real < low || real > high)
              return "'" + text + "' is not " + range;
            text = std::to_string(value);
            return std::string();
          },
          range};
}

CLI::Validator one_of(const std::vector<std::string>& choices) {
  return {[choices](std::string& text) {
            if (std::find(choices.begin(), choices.end(), text) != choices.end()) return std::string();
            const std::string near = did_you_mean(text, choices);
            return "'" + text + "' is none of " + join(choices) + (near.empty() ? "" : "; did you mean " + near + "?");
          },
          "{" + join(choices, ",") + "}"};
}

std::string upper(std::string text) {
  for (char& c : text) c = static_cast<char>(c >= 'a' && c <= 'z' ? c - 'a' + 'A' : c);
  return text;
}

template <class T>
struct Plain {
  using type = T;
};
template <class T>
struct Plain<std::optional<T>> {
  using type = T;
};

// "--out FOLDER": how the option is called, and what stands for its value.
struct OptionName {
  std::string flag, value;
};

OptionName split_name(const std::string& name, const std::string& usual_value = {}) {
  const std::size_t blank = name.find(' ');
  return {name.substr(0, blank), blank == std::string::npos ? usual_value : name.substr(blank + 1)};
}

// Given several times, a value each, and leaving the next word to the operands.
void take_one_each(CLI::Option& word) { word.expected(1)->take_all()->allow_extra_args(false); }

}  // namespace

// Names alone: what verbs declare may name all verbs.
std::vector<std::string> words_of_verbs() {
  std::set<std::string> words;
  for (const Verb& verb : all_verbs()) {
    for (const std::string_view word : words_of(verb.name)) words.emplace(word);
  }
  return {words.begin(), words.end()};
}

template <class T>
T& Options::kept(T usual) {
  const auto made = std::make_shared<T>(std::move(usual));
  kept_.push_back(made);
  return *made;
}

template <class T>
CLI::Option& Options::option(const std::string& name, const char* usual_value, T& into, const std::string& help) {
  const OptionName named = split_name(name, usual_value);
  CLI::Option* made = at_.verb.add_option(named.flag, into, help);
  if constexpr (std::is_arithmetic_v<T> || std::is_same_v<T, std::string>) {
    if (help.find("(default: ") == std::string::npos) made->capture_default_str();
  }
  return *made->type_name(named.value);
}

template <class T>
T& Options::take_operands(const std::string& name, const std::string& help, std::vector<std::string> offered) {
  T& into = kept(T());
  const bool required = name.front() != '[';
  const std::string plain = upper(required ? name : name.substr(1, name.size() - 2));
  CLI::Option& word = *at_.verb.add_option(plain, into, help)->required(required)->type_name("");
  if (required && !offered.empty()) word.check(one_of(offered));
  at_.offered[&word] = std::move(offered);
  return into;
}

std::string& Options::operand(const std::string& name, const std::string& help, std::vector<std::string> offered) {
  return take_operands<std::string>(name, help, std::move(offered));
}

std::vector<std::string>& Options::operands(const std::string& name, const std::string& help,
                                            std::vector<std::string> offered) {
  return take_operands<std::vector<std::string>>(name, help, std::move(offered));
}

bool& Options::flag(const std::string& name, const std::string& help) {
  bool& into = kept(false);
  at_.verb.add_flag(name, into, help);
  return into;
}

std::string& Options::value(const std::string& name, const std::string& help, std::string usual,
                            std::vector<std::string> offered) {
  std::string& into = kept(std::move(usual));
  at_.offered[&option(name, "VALUE", into, help)] = std::move(offered);
  return into;
}

template <class T>
T& Options::value_in(const std::string& name, T usual, double low, double high, const std::string& help) {
  using Number = typename Plain<T>::type;
  constexpr bool kReal = std::is_floating_point_v<Number>;
  const std::string range = kReal ? fmt::format("{} to {}", low, high)
                                  : fmt::format("{} to {}", static_cast<long long>(low), static_cast<long long>(high));
  T& into = kept(std::move(usual));
  CLI::Option& word = option(name, kReal ? "X" : "N", into, help);
  if constexpr (kReal) {  // NaN is in no range
    word.check(number_that(range, [low, high](double value) { return value >= low && value <= high; }));
  } else {
    word.transform(whole_number_in(range, low, high));
  }
  return into;
}
template int& Options::value_in(const std::string&, int, double, double, const std::string&);
template long long& Options::value_in(const std::string&, long long, double, double, const std::string&);
template double& Options::value_in(const std::string&, double, double, double, const std::string&);
template std::optional<int>& Options::value_in(const std::string&, std::optional<int>, double, double,
                                               const std::string&);
template std::optional<long long>& Options::value_in(const std::string&, std::optional<long long>, double, double,
                                                     const std::string&);

std::optional<double>& Options::positive(const std::string& name, const std::string& help) {
  std::optional<double>& into = kept(std::optional<double>());
  option(name, "X", into, help).check(number_that("more than 0", [](double v) { return v > 0 && std::isfinite(v); }));
  return into;
}

std::string& Options::choice(const std::string& name, std::string usual, const std::vector<std::string>& choices,
                             const std::string& help) {
  std::string& into = value(name, help, std::move(usual), choices);
  at_.verb.get_option(split_name(name).flag)->check(one_of(choices));
  return into;
}

std::string& Options::required(const std::string& name, const std::string& help) {
  std::string& into = value(name, help);
  at_.verb.get_option(split_name(name).flag)->required();
  return into;
}

std::vector<std::string>& Options::repeated(const std::string& name, const std::string& help) {
  std::vector<std::string>& into = kept(std::vector<std::string>());
  take_one_each(option(name, "VALUE", into, help));
  return into;
}

std::vector<std::string>& Options::list(const std::string& name, const std::string& help,
                                        const std::vector<std::string>& choices) {
  std::vector<std::string>& into = kept(std::vector<std::string>());
  const auto [flag, shown] = split_name(name, "LIST");
  // CLI11's own delimiter drops what is empty between two commas.
  const std::function<void(const std::vector<std::string>&)> take = [&into, flag = flag, choices](const auto& given) {
    for (const std::string& value : given) {
      for (const std::string_view part : parts_of(value, ',')) {
        std::string item(part), wrong = item.empty() ? "an item between the commas is empty" : "";
        if (wrong.empty() && !choices.empty()) wrong = one_of(choices)(item);
        if (!wrong.empty()) throw CLI::ValidationError(flag, wrong);
        into.push_back(std::move(item));
      }
    }
  };
  CLI::Option& word = *at_.verb.add_option_function<std::vector<std::string>>(flag, take, help);
  take_one_each(word);
  word.type_name(shown + (choices.empty() ? "" : ":{" + join(choices, ",") + "}"));
  if (!choices.empty()) at_.offered[&word] = choices;
  return into;
}

void Options::setting(std::vector<std::string>& set, const std::string& name, const std::string& key,
                      const std::string& help, std::vector<std::string> offered) {
  const auto [flag, shown] = split_name(name);
  const std::function<void(const std::string&)> take = [&set, flag = flag, key](const std::string& value) {
    set.push_back(flag + " " + key + "=" + value);
  };
  at_.offered[at_.verb.add_option_function(flag, take, help)->type_name(shown)] = std::move(offered);
}

void Options::threads(std::vector<std::string>& set) {
  setting(set, "--threads N", "runtime.threads", "CPU threads; results do not depend on it (default: runtime.threads)");
}

void Options::device(std::vector<std::string>& set) {
  setting(set, "--device DEVICE", "runtime.device", "auto, cpu, cuda or cuda:N (default: runtime.device)",
          {"auto", "cpu", "cuda"});
}

std::vector<std::string>& Options::settings() {
  return repeated("--set KEY=VALUE", "override a value: --set train.rays=2048");
}

std::vector<std::string>& Options::run_settings() {
  std::vector<std::string>& set = repeated("--set KEY=VALUE", "override a value of run.yaml");
  threads(set);
  return set;
}

LengthWords Options::training_length() {
  constexpr double kMostSteps = 1e9;
  const LengthWords words{
      value("--time TIME",
            "train for this long, 90s, 5m or 1h: steps and schedule are settled by the rate of the first steps"),
      value_in<std::optional<long long>>(
          "--steps N", {}, 1, kMostSteps,
          "train this many steps, with the schedule of that length (default: train.steps)")};
  excludes("--steps", "--time");
  return words;
}

void Options::needs(const std::string& name, const std::string& other) {
  at_.verb.get_option(name)->needs(at_.verb.get_option(other));
}

void Options::excludes(const std::string& name, const std::string& other) {
  at_.verb.get_option(name)->excludes(at_.verb.get_option(other));
}

AskedLength asked_length(const LengthWords& words) {
  constexpr double kMost_s = 1e8;
  if (words.time.empty()) return {words.steps.value_or(0), 0};
  const char unit = words.time.back();
  const double factor = unit == 's' ? 1 : unit == 'm' ? 60 : unit == 'h' ? 3600 : 0;
  double value = 0;
  const bool number = parse_number(words.time.substr(0, words.time.size() - (factor > 0 ? 1 : 0)), value);
  value *= factor > 0 ? factor : 1;
  if (!number || !(value > 0) || !(value <= kMost_s))
    throw Error(ErrorKind::usage, "usage.value.time",
                "--time " + words.time + ": expected a positive time such as 90s, 5m or 1h");
  return {words.steps.value_or(0), value};
}

// The program: every verb, bound to what runs it.

namespace {

// An option with the name of its value, and behind its sentence what the value may be: the same with every version of
// CLI11.
class Help final : public CLI::Formatter {
 public:
  Help() {
    label("SUBCOMMAND", "VERB");
    label("Positionals", "Operands");
    column_width(kLeft);
  }
  std::string make_subcommand(const CLI::App* verb) const override {
    return fmt::format("  {:<{}}{}\n", verb->get_display_name(), kLeft - 2, wrapped(verb->get_description(), true));
  }
  std::string make_option_opts(const CLI::Option* option) const override {
    const std::string type = option->get_type_name();  // "N:1 to 100"
    return (type.empty() ? "" : " ") + type.substr(0, type.find(':'));
  }
  std::string make_option_desc(const CLI::Option* option) const override {
    std::vector<std::string> facts;
    const std::string type = option->get_type_name();
    if (const std::size_t check = type.find(':'); check != std::string::npos) facts.push_back(type.substr(check + 1));
    if (const std::string usual = option->get_default_str(); !usual.empty()) facts.push_back("default: " + usual);
    if (option->get_required() && !option->get_positional()) facts.emplace_back("required");
    for (const CLI::Option* other : option->get_excludes()) facts.push_back("not with " + other->get_name());
    return wrapped(option->get_description() + (facts.empty() ? "" : " (" + join(facts, "; ") + ")"), false);
  }

 private:
  static constexpr std::size_t kLeft = 26, kRight = 53;  // columns of names and of sentences
  static std::string wrapped(const std::string& text, bool indented) {
    std::string out, line;
    for (const std::string_view word : words_of(text)) {
      if (!line.empty() && line.size() + 1 + word.size() > kRight)
        out += std::exchange(line, "") + "\n" + std::string(indented ? kLeft : 0, ' ');
      line += (line.empty() ? "" : " ") + std::string(word);
    }
    return out + line;
  }
};

struct Program {
  CLI::App app{"Semfield: neural fields of appearance, geometry and semantics for one scene", program_name()};
  OfferedValues offered;
  struct Bound {
    Verb verb;
    Verb::Run run;
  };
  std::map<const CLI::App*, Bound> verbs;
  bool quiet = false, json = false;
  std::vector<std::string> modules;

  Program() {
    app.formatter(std::make_shared<Help>());
    app.fallthrough();             // words of every verb may come behind the verb
    app.require_subcommand(0, 1);  // an operand that is called as a verb is none
    app.set_help_flag("-h,--help", "print this help");
    app.set_help_all_flag("--help-all", "print the help of every verb");
    app.add_flag("-q,--quiet", quiet, "print no progress and no notes");
    app.add_flag("--json", json, "print the results as one JSON object on stdout, if the verb has any");
    take_one_each(*app.add_option("--plugin", modules, "load a plugin module first")->type_name("FILE"));
    app.set_version_flag(
        "--version", [] { return std::string(); }, "print version, compiler, plugin interface and instruction sets");
    app.footer("Options above, but --version, may be given with every verb.\n`" + program_name() +
               " help VERB` prints the words of a verb.\nCodes of errors: docs/reference/codes.md; exit codes: "
               "docs/reference/command_line.md.");
    std::vector<Verb> all = all_verbs();
    std::sort(all.begin(), all.end(), [](const Verb& a, const Verb& b) {
      const auto key = [](const Verb& verb) {
        return std::make_tuple(verb.name.find(' ') != std::string::npos, verb.rank, std::cref(verb.name));
      };
      return key(a) < key(b);
    });
    for (Verb& verb : all) add(verb);
  }

  // A group comes before its verbs.
  void add(Verb& verb) {
    const std::size_t blank = verb.name.find(' ');
    const bool below = blank != std::string::npos;
    CLI::App& parent = below ? *app.get_subcommand(verb.name.substr(0, blank)) : app;
    CLI::App* made = parent.add_subcommand(below ? verb.name.substr(blank + 1) : verb.name, verb.sentence);
    made->group("Verbs");
    if (!verb.declare) {
      made->footer("");
      return;
    }
    made->footer(std::string("Also -q, --plugin") + (verb.json ? ", --json" : "") + ": see `" + program_name() +
                 " help`.");
    Verb::Run run = verb.declare({*made, offered});
    verbs.emplace(made, Bound{std::move(verb), std::move(run)});
  }

  std::string help(const CLI::App& of) const {
    std::string above;
    for (const CLI::App* at = of.get_parent(); at != nullptr; at = at->get_parent())
      above = at->get_name() + (above.empty() ? "" : " " + above);
    std::string examples;
    if (const auto verb = verbs.find(&of); verb != verbs.end())
      for (const std::string words : verb->second.verb.examples)
        examples += "  " + program_name() + " " + verb->second.verb.name + (words.empty() ? "" : " " + words) + "\n";
    return examples + (examples.empty() ? "" : "\n") + of.help(above);
  }
};

std::vector<const CLI::App*> below(const CLI::App& app) { return app.get_subcommands({}); }

const CLI::App* verb_below(const CLI::App& app, const std::string& name) {
  for (const CLI::App* verb : below(app)) {
    if (verb->get_name() == name) return verb;
  }
  return nullptr;
}

// "config check"; "" of the program.
std::string full_name(const CLI::App& app) {
  const CLI::App* parent = app.get_parent();
  if (parent == nullptr) return "";
  const std::string above = full_name(*parent);
  return (above.empty() ? "" : above + " ") + app.get_name();
}

std::string command(const std::string& words) { return "`" + program_name() + " " + words + "`"; }

std::string help_command(const std::string& verb) { return command(verb.empty() ? "help" : "help " + verb); }

// Verbs that are gone, and what is typed in their place.
const std::map<std::string, std::string> kGone{{"bench label", "studies/labelling.py"},
                                               {"bench pairs", "studies/leave_out.py"},
                                               {"bench quadrature", "studies/quadrature.py"},
                                               {"capture", "pack CONFIG --format replica"},
                                               {"check-numerics", "bench numerics"},
                                               {"classes", "labels classes"},
                                               {"completion", "help --completion"},
                                               {"degrade", "labels degrade"},
                                               {"export", "labels export"},
                                               {"fuse", "labels fuse"},
                                               {"propagate", "labels propagate"}};

Error unknown_verb(const CLI::App& at, const std::string& word) {
  const std::string group = full_name(at), name = (group.empty() ? "" : group + " ") + word;
  const std::string text = "there is no verb '" + name + "'";
  if (const auto gone = kGone.find(name); gone != kGone.end())
    return {
        ErrorKind::usage, "usage.verb.unknown", text + " any more",
        "run " + (gone->second.starts_with("studies/") ? gone->second + " of the source tree" : command(gone->second))};
  const CLI::App* program = &at;
  while (program->get_parent() != nullptr) program = program->get_parent();
  std::vector<const CLI::App*> places = below(*program);
  places.insert(places.begin(), &at);
  for (const CLI::App* place : places) {
    std::vector<std::string> names;
    for (const CLI::App* verb : below(*place)) names.push_back(verb->get_name());
    if (const std::string near = did_you_mean(word, names); !near.empty())
      return {ErrorKind::usage, "usage.verb.unknown", text,
              "did you mean " + command(full_name(*verb_below(*place, near))) + "?"};
  }
  return {ErrorKind::usage, "usage.verb.unknown", text, help_command(group) + " lists the verbs"};
}

std::vector<const CLI::Option*> flags_of(const CLI::App& app) {
  return app.get_options([](const CLI::Option* option) { return option->nonpositional(); });
}

Error unknown_flag(const Program& program, const CLI::App& at, const std::string& word) {
  const std::string flag = word.substr(0, word.find('=')), verb = full_name(at);
  const bool early = verb.empty() || at.get_option_no_throw(flag) != nullptr;
  const std::string text = early ? "no verb before the flag " + flag : verb + " has no flag " + flag;
  std::vector<std::string> owners, names;
  for (const auto& [app, bound] : program.verbs) {
    if (app->get_option_no_throw(flag) != nullptr) owners.push_back(command(bound.verb.name));
  }
  if (!owners.empty()) {
    std::sort(owners.begin(), owners.end());
    if (owners.size() > 4) {
      owners.resize(4);
      owners.back() += " and others";
    }
    return {ErrorKind::usage, "usage.flag.unknown", text,
            "it belongs to " + join(owners) + (early ? ", and comes after the verb" : "")};
  }
  for (const CLI::App* app : {&at, &program.app}) {
    for (const CLI::Option* option : flags_of(*app)) names.push_back(option->get_lnames().front());
  }
  const std::string bare = flag.substr(std::min(flag.find_first_not_of('-'), flag.size()));
  const auto longer = std::find_if(names.begin(), names.end(),
                                   [&](const std::string& name) { return bare.size() >= 3 && name.starts_with(bare); });
  const std::string near = longer != names.end() ? *longer : did_you_mean(bare, names);
  return {ErrorKind::usage, "usage.flag.unknown", text,
          near.empty() ? "see " + help_command(verb) : "did you mean --" + near + "?"};
}

// The verb that was typed; the program for none.
const CLI::App& given_verb(const CLI::App& program) {
  const CLI::App* at = &program;
  while (!at->get_subcommands().empty()) at = at->get_subcommands().back();
  return *at;
}

// A word that is unknown comes before what else is wrong, which often follows from it.
Error refused(const Program& program, const CLI::ParseError& error) {
  const CLI::App& at = given_verb(program.app);
  const std::vector<std::string> unknown = program.app.remaining(true);
  for (const std::string& word : unknown) {
    if (word.size() > 1 && word.front() == '-') return unknown_flag(program, at, word);
  }
  if (!unknown.empty() && !below(at).empty()) return unknown_verb(at, unknown.front());
  const std::string verb = full_name(at), see = "see " + help_command(verb);
  if (!unknown.empty())
    return {ErrorKind::usage, "usage.word.unexpected", verb + ": unexpected word '" + unknown.front() + "'", see};
  const std::string text = (verb.empty() ? "" : verb + ": ") + error.what();
  if (dynamic_cast<const CLI::ValidationError*>(&error) || dynamic_cast<const CLI::ConversionError*>(&error))
    return {ErrorKind::usage, "usage.value.invalid", text};
  return {ErrorKind::usage, "usage.word.missing", text, see};
}

int print_version(const Program& program, AppContext& context) {
  const Environment e = this_environment();
  if (program.app.get_option("--json")->count() > 0) {
    context.verb = "version";
    print_json(context, Json::parse(environment_json(e)));
    return 0;
  }
  std::printf("semfield %s (%s)\n", e.version.c_str(), e.source.c_str());
  std::printf("compiler   %s, %s\n", e.compiler.c_str(), e.build_type.c_str());
  std::printf("plugin api %s\n", fmt::format("{}, abi {}", kPluginApi, e.abi).c_str());
  std::printf("cpu        %s\n", fmt::format("{} ({} threads)", e.cpu, e.hardware_threads).c_str());
  std::printf("kernels    %s\n", fmt::format("{} (this build has {})", isa_name(isa()), isas_of_build()).c_str());
  return 0;
}

// A path where a verb is expected: a scene or a configuration alone asks what it is. Another word there is refused
// before CLI11 takes a later one for the verb.
void settle_verb(const Program& program, std::vector<std::string>& words) {
  std::size_t first = 0;
  bool known = true;
  for (; first < words.size() && words[first].starts_with('-'); first += words[first] == "--plugin" ? 2 : 1)
    known = known && program.app.get_option_no_throw(words[first].substr(0, words[first].find('='))) != nullptr;
  if (first >= words.size() || words[first].empty() || verb_below(program.app, words[first]) != nullptr) return;
  if (is_there(words[first]) && !kGone.contains(words[first])) {
    words.insert(words.begin() + static_cast<std::ptrdiff_t>(first), "inspect");
  } else if (known) {
    throw unknown_verb(program.app, words[first]);
  }
}

// What the last of `words`, which may be empty, may become, a line each; none where a shell offers files. A word "="
// alone stands between an option and its value, as bash cuts them.
std::string completions(const std::vector<std::string>& words) {
  const Program program;
  const CLI::App* at = &program.app;
  const CLI::Option* open = nullptr;  // whose value comes next
  std::size_t operands = 0;
  const auto option_named = [&](const std::string& name) {
    const CLI::Option* own = at->get_option_no_throw(name);
    return own != nullptr ? own : program.app.get_option_no_throw(name);
  };
  for (std::size_t i = 0; i + 1 < words.size(); ++i) {
    if (words[i] == "=") continue;
    const CLI::App* next = below(*at).empty() ? nullptr : verb_below(*at, words[i]);
    if (open != nullptr) {
      open = nullptr;
    } else if (words[i].starts_with('-')) {
      open = option_named(words[i]);
      if (open != nullptr && open->get_items_expected_max() == 0) open = nullptr;
    } else if (next != nullptr) {
      at = next;
    } else {
      ++operands;
    }
  }
  // Candidates begin with `head`, which is there already; `rest` is what was typed behind it.
  std::string rest = words.empty() || words.back() == "=" ? "" : words.back(), head, lines;
  if (const std::size_t equals = rest.find('='); rest.starts_with("--") && equals != std::string::npos) {
    open = option_named(rest.substr(0, equals));
    if (open == nullptr) return {};
    head = rest.substr(0, equals + 1);
    rest.erase(0, equals + 1);
  }
  const auto add = [&](const std::string& word) {
    if (word.starts_with(rest)) lines += head + word + "\n";
  };
  const bool flag = rest.starts_with('-');
  const std::vector<const CLI::Option*> places =
      at->get_options([](const CLI::Option* option) { return option->get_positional(); });
  if (open == nullptr && !flag && !places.empty() &&
      (operands < places.size() || places.back()->get_allow_extra_args()))
    open = places[std::min(operands, places.size() - 1)];
  if (open != nullptr) {
    const std::size_t items = rest.rfind(',') + 1;  // of a list
    head += rest.substr(0, items);
    rest.erase(0, items);
    const auto offered = program.offered.find(open);
    if (offered != program.offered.end()) std::for_each(offered->second.begin(), offered->second.end(), add);
  } else if (!flag && !below(*at).empty()) {
    for (const CLI::App* verb : below(*at)) add(verb->get_name());
  } else {
    const auto bound = program.verbs.find(at);
    const bool json = bound == program.verbs.end() || bound->second.verb.json;
    for (const CLI::Option* option : flags_of(*at)) add("--" + option->get_lnames().front());
    if (at != &program.app) {
      for (const CLI::Option* option : flags_of(program.app)) {
        const std::string& name = option->get_lnames().front();
        if (name != "version" && (json || name != "json")) add("--" + name);
      }
    }
  }
  return lines;
}

// As one of several processes that a launcher started.

void refuse_other_words(Ranks& ranks, const std::string& words) {
  const std::vector<std::string> all = texts_of(ranks, words);
  for (int r = 1; r < ranks.size(); ++r) {
    const std::string& theirs = all[static_cast<std::size_t>(r)];
    if (theirs == all.front()) continue;
    throw Error(
        ErrorKind::usage, "ranks.command.differs",
        ranks.name_of(r) + " was started as `semfield " + theirs + "`, and rank 0 as `semfield " + all.front() + "`",
        "start all processes of a run with the same words");
  }
}

int run_launched(const Program::Bound& bound, AppContext& context) {
  const std::optional<Launched> by = launched();
  if (!by || bound.verb.launch == Launch::beside) return bound.run(context);
  if (bound.verb.launch == Launch::alone)
    throw Error(
        ErrorKind::usage, "ranks.verb.single",
        fmt::format("{} started {} processes, but `semfield {}` works in one", by->by, by->size, bound.verb.name),
        "start it without " + by->by + "; train, eval, render and sweep work in several");
  context.ranks = join_ranks(*by);
  Ranks& ranks = *context.ranks;
  const std::string made = prepare_ranks(ranks, this_environment().version);
  refuse_other_words(ranks, context.words);
  if (ranks.rank() != 0) {
    leave_stop_to_rank_0();
    ranks.end_when([] { return stop_signal() != 0; }, {});
    follow(ranks, context.registry);
    return 0;
  }
  print_note(context, made);
  ranks.end_when([] { return stop_signal() != 0; }, stop_with_the_others);
  int code = 0;
  try {
    code = bound.run(context);
  } catch (const RankLost&) {
    throw;
  } catch (...) {
    dismiss(ranks);
    throw;
  }
  dismiss(ranks);
  return code;
}

}  // namespace

bool is_first_process() {
  try {
    const std::optional<Launched> by = launched();
    return !by || by->rank == 0;
  } catch (const Error&) {  // what is wrong with the environment every process says
    return true;
  }
}

std::string help_of(const std::vector<std::string>& verb) {
  const Program program;
  const CLI::App* at = &program.app;
  for (const std::string& word : verb) {
    const CLI::App* next = verb_below(*at, word);
    if (next == nullptr) throw unknown_verb(*at, word);
    at = next;
  }
  return program.help(*at);
}

std::string help_of_all(const std::function<std::string(const std::string& verb, const std::string& help)>& shown) {
  const Program program;
  std::string text = shown("", program.app.help());
  const std::function<void(const CLI::App&)> add = [&](const CLI::App& of) {
    for (const CLI::App* verb : below(of)) {
      text += shown(full_name(*verb), program.help(*verb));
      add(*verb);
    }
  };
  add(program.app);
  return text;
}

std::string verbs_page() {
  return "# Verbs\n\n[command_line.md](command_line.md) has what holds for every verb, [json.md](json.md) the keys of "
         "`--json`.\n" +
         help_of_all([](const std::string& verb, const std::string& help) {
           return (verb.empty() ? "" : "\n## " + verb + "\n") + "\n```text\n" + help + "```\n";
         });
}

int run_command_line(int argc, char** argv, AppContext& context) {
  std::vector<std::string> words(argv + 1, argv + argc), shown;
  if (words.size() > 1 && words[0] == "help" && words[1] == "--complete") {  // unparsed: half a line
    std::fputs(completions({words.begin() + 2, words.end()}).c_str(), stdout);
    return 0;
  }
  for (const std::string& word : words) shown.push_back(shell_word(word));
  Program program;
  settle_verb(program, words);
  std::reverse(words.begin(), words.end());
  try {
    program.app.parse(words);
  } catch (const CLI::CallForHelp&) {
    std::fputs(program.help(given_verb(program.app)).c_str(), stdout);
    return 0;
  } catch (const CLI::CallForAllHelp&) {
    const std::string all =
        help_of_all([](const std::string& verb, const std::string& help) { return (verb.empty() ? "" : "\n") + help; });
    std::fputs(all.c_str(), stdout);
    return 0;
  } catch (const CLI::CallForVersion&) {
    return print_version(program, context);
  } catch (const CLI::ParseError& error) {
    throw refused(program, error);
  }
  context.quiet = program.quiet;
  context.json = program.json;
  const auto found = program.verbs.find(&given_verb(program.app));
  if (found == program.verbs.end()) {
    // Nothing was done, and a script whose verb got lost should not continue as if something had been.
    std::fputs(program.app.help().c_str(), stdout);
    return static_cast<int>(ErrorKind::usage);
  }
  const Program::Bound& bound = found->second;
  context.verb = bound.verb.name;
  context.words = join(shown, " ");
  if (context.json && !bound.verb.json)
    throw Error(ErrorKind::usage, "usage.json.none", bound.verb.name + " takes no --json", "leave it out");
  for (const std::string& module : program.modules) load_module(context.registry, module);
  return run_launched(bound, context);
}

}  // namespace semfield::app
