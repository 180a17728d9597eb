#include "app/command_line.h"

#include <CLI/CLI.hpp>
#include <algorithm>
#include <cmath>
#include <optional>
#include <tuple>

#include "app/verb.h"
#include "plugin/loader.h"

namespace semfield::app {

namespace {

// CLI::PositiveNumber takes "nan".
CLI::Validator positive_number() {
  return {[](const std::string& text) {
            double value = 0;
            const bool read = CLI::detail::lexical_cast(text, value);
            return read && value > 0 && std::isfinite(value) ? std::string()
                                                             : "expected a positive number, got '" + text + "'";
          },
          "POSITIVE"};
}

// Groups before their verbs, both by rank.
std::vector<Verb> ordered_verbs() {
  std::vector<Verb> verbs = all_verbs();
  std::sort(verbs.begin(), verbs.end(), [](const Verb& a, const Verb& b) {
    const auto key = [](const Verb& verb) {
      return std::make_tuple(verb.name.find(' ') != std::string::npos, verb.rank, std::cref(verb.name));
    };
    return key(a) < key(b);
  });
  return verbs;
}

// `chosen` becomes the verb that the words name.
void add_verb(CLI::App& root, const Verb& verb, Verb::Run& chosen) {
  const std::size_t space = verb.name.find(' ');
  CLI::App& parent = space == std::string::npos ? root : *root.get_subcommand(verb.name.substr(0, space));
  CLI::App* app =
      parent.add_subcommand(space == std::string::npos ? verb.name : verb.name.substr(space + 1), verb.sentence);
  if (!verb.declare) {
    app->require_subcommand(1);
    return;
  }
  VerbWords words(*app);
  app->callback([run = verb.declare(words), &chosen] { chosen = run; });
}

}  // namespace

void VerbWords::operand(const std::string& name, std::string& into, const std::string& help) {
  verb_.add_option(name, into, help)->required();
}

void VerbWords::optional_operand(const std::string& name, std::string& into, const std::string& help) {
  verb_.add_option(name, into, help);
}

void VerbWords::operands(const std::string& name, std::vector<std::string>& into, const std::string& help) {
  verb_.add_option(name, into, help)->required();
}

void VerbWords::optional_operands(const std::string& name, std::vector<std::string>& into, const std::string& help) {
  verb_.add_option(name, into, help);
}

void VerbWords::flag(const std::string& name, bool& into, const std::string& help) { verb_.add_flag(name, into, help); }

template <class T>
void VerbWords::value(const std::string& name, T& into, const std::string& help) {
  verb_.add_option(name, into, help);
}
template void VerbWords::value(const std::string&, std::string&, const std::string&);
template void VerbWords::value(const std::string&, int&, const std::string&);
template void VerbWords::value(const std::string&, long long&, const std::string&);
template void VerbWords::value(const std::string&, double&, const std::string&);
template void VerbWords::value(const std::string&, std::optional<long long>&, const std::string&);
template void VerbWords::value(const std::string&, std::optional<double>&, const std::string&);

template <class T>
void VerbWords::value_in(const std::string& name, T& into, int low, int high, const std::string& help) {
  verb_.add_option(name, into, help)->check(CLI::Range(low, high));
}
template void VerbWords::value_in(const std::string&, int&, int, int, const std::string&);
template void VerbWords::value_in(const std::string&, long long&, int, int, const std::string&);
template void VerbWords::value_in(const std::string&, std::optional<int>&, int, int, const std::string&);

template <class T>
void VerbWords::positive(const std::string& name, T& into, const std::string& help) {
  verb_.add_option(name, into, help)->check(positive_number());
}
template void VerbWords::positive(const std::string&, double&, const std::string&);
template void VerbWords::positive(const std::string&, std::optional<double>&, const std::string&);

void VerbWords::required(const std::string& name, std::string& into, const std::string& help) {
  verb_.add_option(name, into, help)->required();
}

void VerbWords::repeated(const std::string& name, std::vector<std::string>& into, const std::string& help) {
  verb_.add_option(name, into, help)->expected(1)->take_all();
}

void VerbWords::list(const std::string& name, std::vector<std::string>& into, const std::string& help) {
  verb_.add_option(name, into, help)->delimiter(',');
}

void VerbWords::setting(std::vector<std::string>& set, const std::string& name, const std::string& key,
                        const std::string& help) {
  verb_.add_option_function<std::string>(
      name, [&set, name, key](const std::string& value) { set.push_back(name + " " + key + "=" + value); }, help);
}

void VerbWords::threads(std::vector<std::string>& set) {
  setting(set, "--threads", "runtime.threads", "CPU threads (results do not depend on it)");
}

void VerbWords::config(ConfigOptions& options) {
  operand("config", options.config, "configuration file (YAML)");
  repeated("--set", options.set, "override a value: --set train.rays=2048");
}

void VerbWords::run_settings(std::vector<std::string>& set) {
  repeated("--set", set, "override a value of run.yaml");
  threads(set);
}

void VerbWords::needs(const std::string& name, const std::string& other) {
  verb_.get_option(name)->needs(verb_.get_option(other));
}

void VerbWords::excludes(const std::string& name, const std::string& other) {
  verb_.get_option(name)->excludes(verb_.get_option(other));
}

int run_command_line(int argc, char** argv, AppContext& context) {
  CLI::App root{"Semfield: neural fields of appearance, geometry and semantics for one scene", "semfield"};
  root.require_subcommand(1);
  root.fallthrough();
  root.add_flag("-q,--quiet", context.quiet, "print no progress and no notes");
  root.add_flag("--json", context.json, "print results as JSON on stdout");
  std::vector<std::string> modules;
  root.add_option("--plugin", modules, "load a plugin module first: FILE.so")->expected(1)->take_all();
  Verb::Run chosen;
  for (const Verb& verb : ordered_verbs()) add_verb(root, verb, chosen);
  try {
    root.parse(argc, argv);
  } catch (const CLI::ParseError& error) {
    const int code = root.exit(error);
    return code == 0 ? 0 : static_cast<int>(ErrorKind::usage);
  }
  for (const std::string& module : modules) load_module(context.registry, module);
  return chosen ? chosen(context) : static_cast<int>(ErrorKind::usage);
}

}  // namespace semfield::app
