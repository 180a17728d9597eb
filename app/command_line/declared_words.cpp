// Words of verbs as they are declared: how each takes a value, and what it says about one that it does not take.
#include <fmt/format.h>

#include <algorithm>
#include <charconv>
#include <cmath>
#include <optional>
#include <set>
#include <type_traits>

#include "app/command_line/grammar.h"
#include "app/verb.h"
#include "core/check.h"
#include "core/text.h"

namespace semfield::app {

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
