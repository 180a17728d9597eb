// How a file of verbs/ makes verbs: it defines `Verb verb_NAME()` for each, which the build finds.
#pragma once

#include <array>
#include <cstdint>
#include <functional>
#include <map>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "app/app_context.h"
#include "config/params.h"
#include "config/settings/choices.h"
#include "core/non_copyable.h"

namespace CLI {
class App;
class Option;
}  // namespace CLI

namespace semfield::app {

/// `--time 90s` and `--steps N` of the verbs that train.
struct LengthWords {
  const std::string& time;  ///< "90s", "5m", "1h"
  const std::optional<long long>& steps;
};

/// Throws Error(usage) for what is no positive time such as 90s, 5m or 1h.
AskedLength asked_length(const LengthWords& words);

/// Values that completion offers for an option or an operand.
using OfferedValues = std::map<const CLI::Option*, std::vector<std::string>>;

/// Where a verb declares its words.
struct Declaration {
  CLI::App& verb;
  OfferedValues& offered;
};

/// The words that a verb takes: a struct that derives from this has a reference for each, made by the call that
/// declares it. Values are written when the command line is read.
///
/// The name of an option is followed by what stands for its value, "--out FOLDER". A usual value that is not empty is
/// stated as the default. A number has a range, which is checked here and stated in the help.
class Options : NonCopyable {
 public:
  explicit Options(const Declaration& at) : at_(at) {}

 protected:
  /// A word that must be there; "[name]" may be left out. One that must be there is one of `offered`, if any are;
  /// completion alone offers those of others.
  std::string& operand(const std::string& name, const std::string& help, std::vector<std::string> offered = {});
  /// One or several.
  std::vector<std::string>& operands(const std::string& name, const std::string& help,
                                     std::vector<std::string> offered = {});

  bool& flag(const std::string& name, const std::string& help);
  /// `offered` are values that completion offers; others are taken too.
  std::string& value(const std::string& name, const std::string& help, std::string usual = {},
                     std::vector<std::string> offered = {});
  /// T is int, long long, double or an optional of one.
  template <class T>
  T& value_in(const std::string& name, T usual, double low, double high, const std::string& help);
  /// A finite number above 0.
  std::optional<double>& positive(const std::string& name, const std::string& help);
  /// One of `choices`.
  std::string& choice(const std::string& name, std::string usual, const std::vector<std::string>& choices,
                      const std::string& help);
  std::string& required(const std::string& name, const std::string& help);
  /// May be given several times, a value each.
  std::vector<std::string>& repeated(const std::string& name, const std::string& help);
  /// Values with commas between them; with `choices`, each is one of them.
  std::vector<std::string>& list(const std::string& name, const std::string& help,
                                 const std::vector<std::string>& choices = {});

  /// `--set` of a configuration.
  std::vector<std::string>& settings();
  /// A short form of `--set KEY=...`: added behind `--set`, whose values it follows; whoever reads the configuration
  /// checks the value.
  void setting(std::vector<std::string>& set, const std::string& name, const std::string& key, const std::string& help,
               std::vector<std::string> offered = {});
  void threads(std::vector<std::string>& set);
  void device(std::vector<std::string>& set);
  /// `--set` and `--threads` of a verb that opens a run.
  std::vector<std::string>& run_settings();
  /// Of which a command line has one.
  LengthWords training_length();

  /// Of options declared before.
  void needs(const std::string& name, const std::string& other);
  void excludes(const std::string& name, const std::string& other);

 private:
  template <class T>
  T& kept(T usual);
  template <class T>
  CLI::Option& option(const std::string& name, const char* usual_value, T& into, const std::string& help);
  template <class T>
  T& take_operands(const std::string& name, const std::string& help, std::vector<std::string> offered);

  Declaration at_;
  std::vector<std::shared_ptr<void>> kept_;
};

/// Of a verb that serves a page.
struct PageVerbOptions : Options {
  using Options::Options;
  const std::optional<int>& port = value_in<std::optional<int>>(
      "--port N", {}, 1, 65535, "port to listen on (default: 8787, or the next that is free)");
  const std::string& address =
      value("--address ADDRESS", "IPv4 address to listen on; 127.0.0.1 is this machine alone, 0.0.0.0 every network",
            "127.0.0.1");
};

/// What a verb does as one of several processes that mpirun or srun started.
enum class Launch : std::uint8_t {
  alone,   ///< it is refused
  ranks,   ///< rank 0 runs it with AppContext::ranks, and the others follow (train/session.h)
  beside,  ///< every process runs it, and it sees to the others itself
};

/// A verb of the program, or a group of verbs.
struct Verb {
  using Run = std::function<int(AppContext&)>;

  std::string name;  ///< "train"; "config check" is the verb `check` of the group `config`
  int rank = 0;      ///< the help lists verbs in this order, those of a group among themselves
  std::string sentence;
  std::array<const char*, 2> examples;             ///< words behind its name, which run as they stand
  std::function<Run(const Declaration&)> declare;  ///< what runs when the words are read; empty: a group
  Launch launch = Launch::alone;
  bool json = true;  ///< takes --json, and then prints its results by print_json() (app/app_context.h)
};

/// `run` gets the words that Words declares, and returns the exit code.
template <class Words>
Verb make_verb(std::string name, int rank, std::string sentence, std::array<const char*, 2> examples,
               int (*run)(const Words&, AppContext&), Launch launch = Launch::alone) {
  return {std::move(name),
          rank,
          std::move(sentence),
          examples,
          [run](const Declaration& at) -> Verb::Run {
            return [words = std::make_shared<Words>(at), run](AppContext& context) { return run(*words, context); };
          },
          launch};
}

inline Verb without_json(Verb verb) {
  verb.json = false;
  return verb;
}

inline Verb make_group(std::string name, int rank, std::string sentence) {
  return {std::move(name), rank, std::move(sentence), {}, {}};
}

/// Names of a setting's choices, by value.
template <class T>
std::vector<std::string> choice_names() {
  return {ChoiceNames<T>::names.begin(), ChoiceNames<T>::names.end()};
}

/// The words of which names of verbs are made, each once: for completion.
std::vector<std::string> words_of_verbs();

/// The name that users type. The build writes this and the next (app/CMakeLists.txt).
const std::string& program_name();
/// Every verb_NAME() of the program, in no order.
std::vector<Verb> all_verbs();

// Words to verbs, by CLI11, which parses them and prints their help (command_line.cpp).

/// Parses and runs; returns the exit code. Throws Error(usage) for words that no verb takes. As one of several
/// processes of a launcher it runs a verb as its `launch` says, and refuses ranks that were started with different
/// words: rank 0's alone would count.
int run_command_line(int argc, char** argv, AppContext& context);

/// Whether this process prints what went wrong before it has joined the others: rank 0 does, and who is alone.
bool is_first_process();

/// What `semfield VERB --help` prints; of the program where `verb` is empty. Throws Error(usage) for what is no verb.
std::string help_of(const std::vector<std::string>& verb);
/// docs/reference/verbs.md: the help of every verb.
std::string verbs_page();

}  // namespace semfield::app
