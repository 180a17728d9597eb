// Parameters declared once: name, type, default, range and sentence stand on one line of describe(); reading,
// validation, help, the reference page, resolved YAML are visitors over it. No YAML and no template
// of ours crosses a module border.
#pragma once

#include <algorithm>
#include <array>
#include <cstdint>
#include <functional>
#include <limits>
#include <span>
#include <string>
#include <string_view>
#include <type_traits>
#include <variant>
#include <vector>

#include "config/config_tree.h"
#include "core/error.h"

namespace semfield {

/// Closed interval of allowed values; for lists, of each element.
struct Range {
  double min = -std::numeric_limits<double>::infinity();
  double max = std::numeric_limits<double>::infinity();
};

struct ParamInfo {
  std::string_view name;
  std::string_view help;  ///< one sentence, with the unit and, for a formula's symbol, its source
  Range range{};
};

/// A choice: `index` is that of one of the names.
struct ChosenName {
  int index = 0;
  std::span<const std::string_view> names;
};
/// A parameter's value.
using ParamValue = std::variant<bool*, std::int64_t*, double*, std::string*, ChosenName*, std::vector<std::int64_t>*,
                                std::vector<double>*, std::vector<std::string>*>;
/// Receives every parameter of a struct in declaration order. A reader assigns, a writer or describer only looks.
using ParamVisitor = std::function<void(const ParamInfo& info, ParamValue value)>;

/// An enum becomes a choice by its names, in the order of its values from 0 on: SEMFIELD_CHOICES(Enum, "first", ...);
template <class Enum>
struct ChoiceNames;
#define SEMFIELD_CHOICES(Enum, ...)                                               \
  template <>                                                                     \
  struct ChoiceNames<Enum> {                                                      \
    static constexpr auto names = std::to_array<std::string_view>({__VA_ARGS__}); \
  }

template <class Enum>
std::string choice_name(Enum value) {
  return std::string(ChoiceNames<Enum>::names[static_cast<std::size_t>(value)]);
}

template <class T>
void visit_param(const ParamVisitor& visit, std::string_view name, T& value, std::string_view help, Range range = {}) {
  if constexpr (std::is_enum_v<T>) {
    ChosenName choice{static_cast<int>(value), ChoiceNames<T>::names};
    visit({name, help, range}, &choice);
    value = static_cast<T>(choice.index);
  } else if constexpr (std::is_arithmetic_v<T> && !std::is_same_v<T, bool>) {
    // What the field's own type cannot hold is out of range, never wrapped and never infinite.
    if constexpr (!std::is_same_v<T, double>) {
      range.min = std::max(range.min, static_cast<double>(std::numeric_limits<T>::lowest()));
      range.max = std::min(range.max, static_cast<double>(std::numeric_limits<T>::max()));
    }
    std::conditional_t<std::is_integral_v<T>, std::int64_t, double> wide = value;
    visit({name, help, range}, &wide);
    value = static_cast<T>(wide);
  } else {
    visit({name, help, range}, &value);
  }
}

}  // namespace semfield

/// SEMFIELD_PARAM(visit, params, field, "sentence", {min, max}): the one line that declares a parameter.
#define SEMFIELD_PARAM(visit, params, field, help, ...) \
  ::semfield::visit_param(visit, #field, (params).field, help __VA_OPT__(, ::semfield::Range __VA_ARGS__))

// From the tree to parameter structs, with every error of a node collected.
namespace semfield {

/// Anything with parameters: calls describe(visitor, params) of some struct.
using Describe = std::function<void(ParamVisitor&)>;
/// That of a struct, or of an object with a member describe(); `params` must outlive it.
template <class Params>
Describe described(Params& params) {
  return [&params](ParamVisitor& visit) {
    if constexpr (requires { params.describe(visit); }) {
      params.describe(visit);
    } else {
      describe(visit, params);
    }
  };
}

/// see(info, value) for every parameter, with a value of its own type.
template <class See>
void each_param(const Describe& describe, const See& see) {
  ParamVisitor visitor = [&](const ParamInfo& info, ParamValue value) {
    std::visit([&](auto* of_type) { see(info, *of_type); }, value);
  };
  describe(visitor);
}

/// What messages and tables call the types of ParamValue, in its order, and that of one.
inline constexpr auto kTypeNames = std::to_array<std::string_view>(
    {"bool", "int", "number", "text", "choice", "list of int", "list of number", "list of text"});
template <class T>
inline constexpr std::string_view kTypeName = kTypeNames[ParamValue(static_cast<T*>(nullptr)).index()];

/// Reads the keys of `node` into the parameters. Unknown keys are errors with "did you mean" unless listed in
/// `other_keys`; wrong types, ranges and choices are errors with place, path, expected and found, e.g.
/// "room.yaml:9:21: encoder.log2_entries: expected int, got 'big'". `path` is the key path of `node` for messages. A
/// missing key keeps its default.
void read_params(const ConfigNode& node, const std::string& path, const Describe& describe, Diagnostics& diagnostics,
                 const std::vector<std::string>& other_keys = {});

/// read(item, its path) for the items of the list at `path`. Nothing may be written there; else it is a list, or an
/// error that says of what.
void read_items(const ConfigNode& tree, const std::string& path, const std::string& of, const std::string& remedy,
                Diagnostics& diagnostics,
                const std::function<void(const ConfigNode& item, const std::string& path)>& read);

/// An error with "did you mean" for each key of `map` that is not known: "<what> 'KEY'".
void refuse_unknown_keys(const ConfigNode& map, const std::string& what, const std::vector<std::string>& known,
                         Diagnostics& diagnostics);

/// The resolved values as a tree: every parameter, defaults included, in declaration order.
ConfigNode params_to_config(const Describe& describe);

/// One parameter, as reference page and help need it. `type` is bool, int, number, text, choice, or list of
/// int, number or text; `range` is "[1, 32]", ">= 1", "<= 5" or empty.
struct ParamDoc {
  std::string name, type, default_value, range, help;
  std::vector<std::string> choices;
};
std::vector<ParamDoc> describe_params(const Describe& describe);

/// Shortest decimal that reads back as the same double, a number to YAML 1.1 too: "64.0", "1.0e-05".
std::string shortest_number(double value);

/// "[1, 32]", ">= 1", "<= 5" or "" for messages and tables; `hide_type_limits` leaves out a bound that only says what
/// the field's type can hold.
std::string range_text(const Range& range, bool hide_type_limits);

/// Scalar readers for keys that belong to no struct; they report into `diagnostics` and return the fallback on error.
std::string read_text(const ConfigNode& parent, const std::string& path, const std::string& key,
                      const std::string& fallback, Diagnostics& diagnostics);

}  // namespace semfield
