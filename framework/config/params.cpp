// Reads a map of the tree into a parameter struct, strictly, collecting every error.
#include "config/params.h"

#include <algorithm>
#include <array>
#include <charconv>
#include <cmath>
#include <optional>
#include <system_error>
#include <utility>

#include "config/explain.h"
#include "core/check.h"
#include "core/text.h"

namespace semfield {
namespace {

// A number in decimal: [+-] digits, and for a double also a point and an exponent; without leading zeros, since
// YAML 1.1 reads some such numbers as octal and YAML 1.2 as decimal. None with a remedy, "" where the text is no number
// at all.
template <class T>
std::optional<T> number_of(std::string_view text, std::string& remedy) {
  constexpr bool kWhole = std::is_integral_v<T>;
  const std::string_view bare = text.substr(text.starts_with('-') || text.starts_with('+') ? 1 : 0);
  for (const std::string_view word : {".nan", ".NaN", ".NAN", ".inf", ".Inf", ".INF", "nan", "inf"})
    if (!kWhole && bare == word) remedy = "only finite numbers are allowed";
  if (bare.empty() || !(is_digit(bare[0]) || bare[0] == '.')) return std::nullopt;
  if (text[0] == '+') text = bare;
  T value{};
  const auto [end, status] = std::from_chars(text.data(), text.data() + text.size(), value);
  if (status == std::errc::invalid_argument || end != text.data() + text.size()) return std::nullopt;
  if (bare.size() > 1 && bare[0] == '0' && is_digit(bare[1])) {
    remedy = "write it without leading zeros";
  } else if (status != std::errc{}) {
    remedy = kWhole ? "it does not fit 64 bits" : "it is beyond the range of a double";
  }
  return remedy.empty() ? std::optional(value) : std::nullopt;
}

// see(info, value) for every parameter, with a value of its own type.
template <class See>
void each_param(const Describe& describe, const See& see) {
  ParamVisitor visitor = [&](const ParamInfo& info, ParamValue value) {
    std::visit([&](auto* of_type) { see(info, *of_type); }, value);
  };
  describe(visitor);
}

std::string type_of(bool) { return "bool"; }
std::string type_of(std::int64_t) { return "int"; }
std::string type_of(double) { return "number"; }
std::string type_of(const std::string&) { return "text"; }
std::string type_of(const ChosenName&) { return "choice"; }
template <class T>
std::string type_of(const std::vector<T>&) {
  return "list of " + type_of(T{});
}

// read(node, key path, allowed range, value) for every type: false where the node holds no such value, which is then
// reported, and `value` stays.
struct Reader {
  Diagnostics& diagnostics;

  bool report(Code code, const ConfigNode& node, const std::string& path, const std::string& expected,
              const std::string& got, const std::string& remedy = {}) {
    diagnostics.error(code, node.location().text(), path + ": expected " + expected + ", got " + got, remedy);
    return false;
  }

  bool read(const ConfigNode& node, const std::string& path, const Range&, bool& value) {
    if (!node.is_scalar() || node.quoted() || (node.text() != "true" && node.text() != "false"))
      return report("config.value.type", node, path, "bool", kind_text(node), "write true or false");
    value = node.text() == "true";
    return true;
  }
  bool read(const ConfigNode& node, const std::string& path, const Range&, std::string& value) {
    if (!node.is_scalar()) return report("config.value.type", node, path, "text", kind_text(node));
    value = node.text();
    return true;
  }
  bool read(const ConfigNode& node, const std::string& path, const Range&, ChosenName& choice) {
    const auto named = std::find(choice.names.begin(), choice.names.end(), node.text());
    if (node.is_scalar() && named != choice.names.end()) {
      choice.index = static_cast<int>(named - choice.names.begin());
      return true;
    }
    const std::vector<std::string> known(choice.names.begin(), choice.names.end());
    return report("config.value.choice", node, path, "one of " + join(known), kind_text(node),
                  node.is_scalar() ? near_name_remedy(node.text(), known) : "");
  }
  // The list is taken whole or, when an item is wrong, not at all.
  template <class T>
  bool read(const ConfigNode& node, const std::string& path, const Range& range, std::vector<T>& value) {
    if (!node.is_list())
      return report("config.value.type", node, path, type_of(value), kind_text(node),
                    node.is_scalar() ? "write [" + node.text() + "]" : "");
    std::vector<T> items;
    bool whole = true;
    for (std::size_t i = 0; i < node.items().size(); ++i) {
      T item{};
      whole = read(node.items()[i], path + "." + std::to_string(i), range, item) && whole;
      items.push_back(std::move(item));
    }
    if (whole) value = std::move(items);
    return whole;
  }

  // A number.
  template <class T>
  bool read(const ConfigNode& node, const std::string& path, const Range& range, T& value) {
    std::string remedy;
    std::optional<T> read;
    if (node.is_scalar() && !node.quoted()) read = number_of<T>(node.text(), remedy);
    if (!read) {
      if (node.is_scalar() && node.quoted()) remedy = "numbers stand without quotes";
      return report("config.value.type", node, path, type_of(T{}), kind_text(node), remedy);
    }
    if (!in_range(node, path, range, static_cast<double>(*read), type_of(T{}))) return false;
    value = *read;
    return true;
  }

  // "int in [1, 32]", "int >= 1": a limit of the field's type is named only when it is what the value breaks.
  bool in_range(const ConfigNode& node, const std::string& path, const Range& range, double value,
                const std::string& type) {
    if (value >= range.min && value <= range.max) return true;
    Range broken;
    (value < range.min ? broken.min : broken.max) = value < range.min ? range.min : range.max;
    const bool breaks_type_limit = range_text(broken, true).empty();
    const std::string bounds = range_text(range, !breaks_type_limit);
    return report("config.value.range", node, path, type + (bounds[0] == '[' ? " in " : " ") + bounds, node.text());
  }
};

ConfigNode node_of(bool value) { return ConfigNode::make_scalar(value ? "true" : "false", false, {}); }
ConfigNode node_of(std::int64_t value) { return ConfigNode::make_scalar(std::to_string(value), false, {}); }
ConfigNode node_of(double value) { return ConfigNode::make_scalar(shortest_number(value), false, {}); }
ConfigNode node_of(const std::string& value) { return ConfigNode::make_scalar(value, !is_plain_text(value), {}); }
ConfigNode node_of(const ChosenName& choice) {
  SEMFIELD_CHECK(choice.index >= 0 && static_cast<std::size_t>(choice.index) < choice.names.size(),
                 "choice outside its names");
  return node_of(std::string(choice.names[static_cast<std::size_t>(choice.index)]));
}
template <class T>
ConfigNode node_of(const std::vector<T>& values) {
  std::vector<ConfigNode> items;
  for (const T& value : values) items.push_back(node_of(value));
  return ConfigNode::make_list(std::move(items), {});
}

template <class Int>
bool is_limit_of(double value, bool upper) {
  return value == static_cast<double>(upper ? std::numeric_limits<Int>::max() : std::numeric_limits<Int>::lowest());
}

// visit_param narrows a range to what the field's type holds; such a bound says nothing to a reader.
bool is_type_limit(double value, bool upper) {
  return std::isinf(value) || is_limit_of<std::int32_t>(value, upper) || is_limit_of<std::int64_t>(value, upper) ||
         (upper && (is_limit_of<std::uint32_t>(value, upper) || is_limit_of<std::uint64_t>(value, upper))) ||
         is_limit_of<float>(value, upper) || is_limit_of<double>(value, upper);
}

std::string bound_text(double value) {
  if (value == std::floor(value) && std::fabs(value) < 1e15) return std::to_string(static_cast<std::int64_t>(value));
  return shortest_number(value);
}

}  // namespace

void read_params(const ConfigNode& node, const std::string& path, const Describe& describe, Diagnostics& diagnostics,
                 const std::vector<std::string>& other_keys) {
  const std::string prefix = path.empty() ? "" : path + ": ";
  if (!node.is_map() && !node.is_null()) {  // a section with every line commented out is an empty one
    diagnostics.error("config.value.type", node.location().text(), prefix + "expected a map, got " + kind_text(node),
                      {});
    return;
  }
  Reader reader{diagnostics};
  std::vector<std::string> known;
  each_param(describe, [&](const ParamInfo& info, auto& value) {
    known.emplace_back(info.name);
    const ConfigNode* child = node.find(info.name);
    if (child != nullptr)
      reader.read(*child, path.empty() ? known.back() : path + "." + known.back(), info.range, value);
  });
  known.insert(known.end(), other_keys.begin(), other_keys.end());
  refuse_unknown_keys(node, prefix + "unknown key", known, diagnostics);
}

void read_items(const ConfigNode& tree, const std::string& path, const std::string& of, const std::string& remedy,
                Diagnostics& diagnostics,
                const std::function<void(const ConfigNode& item, const std::string& path)>& read) {
  const ConfigNode* list = tree.given(path);
  if (list == nullptr) return;
  if (!list->is_list())
    return diagnostics.error("config.value.type", list->location().text(), path + ": expected a list of " + of, remedy);
  for (std::size_t i = 0; i < list->items().size(); ++i) read(list->items()[i], path + "." + std::to_string(i));
}

void refuse_unknown_keys(const ConfigNode& map, const std::string& what, const std::vector<std::string>& known,
                         Diagnostics& diagnostics) {
  for (const auto& [key, value] : map.entries()) {
    if (std::find(known.begin(), known.end(), key) != known.end()) continue;
    diagnostics.error("config.key.unknown", value.key_location().text(), what + " '" + key + "'",
                      near_name_remedy(key, known, known.empty() ? "there are no keys here" : "known: " + join(known)));
  }
}

std::string read_text(const ConfigNode& parent, const std::string& path, const std::string& key,
                      const std::string& fallback, Diagnostics& diagnostics) {
  const ConfigNode* node = parent.find(key);
  if (node == nullptr) return fallback;
  if (node->is_scalar()) return node->text();
  diagnostics.error("config.value.type", node->location().text(),
                    (path.empty() ? key : path + "." + key) + ": expected text, got " + kind_text(*node), {});
  return fallback;
}

// The values of a parameter struct as a tree, for the resolved config.

std::string shortest_number(double value) {
  SEMFIELD_CHECK(std::isfinite(value), "a parameter must be finite to be written");
  std::array<char, 32> buffer{};
  const auto end = std::to_chars(buffer.data(), buffer.data() + buffer.size(), value).ptr;
  std::string text(buffer.data(), end);
  // Readers of YAML 1.1 take "1e-05" for a text: a number has a point.
  if (text.find('.') == std::string::npos) text.insert(std::min(text.find('e'), text.size()), ".0");
  return text;
}

ConfigNode params_to_config(const Describe& describe) {
  std::vector<ConfigNode::Entry> entries;
  each_param(describe, [&](const ParamInfo& info, const auto& value) {
    entries.emplace_back(std::string(info.name), node_of(value));
  });
  return ConfigNode::make_map(std::move(entries), {});
}

// Parameters as rows of text: help, reference page, schema.

std::string range_text(const Range& range, bool hide_type_limits) {
  const auto is_open = [&](double value, bool upper) {
    return std::isinf(value) || (hide_type_limits && is_type_limit(value, upper));
  };
  const bool low_open = is_open(range.min, false), high_open = is_open(range.max, true);
  if (low_open && high_open) return {};
  if (high_open) return ">= " + bound_text(range.min);
  if (low_open) return "<= " + bound_text(range.max);
  return "[" + bound_text(range.min) + ", " + bound_text(range.max) + "]";
}

std::vector<ParamDoc> describe_params(const Describe& describe) {
  std::vector<ParamDoc> docs;
  each_param(describe, [&]<class T>(const ParamInfo& info, const T& value) {
    ParamDoc& doc = docs.emplace_back();
    doc.name = info.name;
    doc.type = type_of(value);
    doc.help = info.help;
    doc.limits = info.range;
    if (is_type_limit(doc.limits.min, false)) doc.limits.min = -std::numeric_limits<double>::infinity();
    if (is_type_limit(doc.limits.max, true)) doc.limits.max = std::numeric_limits<double>::infinity();
    doc.range = range_text(doc.limits, true);
    doc.default_value = write_config_inline(node_of(value));
    if constexpr (std::is_same_v<T, ChosenName>) doc.choices.assign(value.names.begin(), value.names.end());
  });
  return docs;
}

}  // namespace semfield
