// Reads a map of the tree into a parameter struct, strictly, collecting every error.
#include "config/params.h"

#include <charconv>
#include <optional>
#include <system_error>
#include <utility>

#include "config/explain.h"
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
      return report("config.value.type", node, path, std::string(kTypeName<std::vector<T>>), kind_text(node),
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
      return report("config.value.type", node, path, std::string(kTypeName<T>), kind_text(node), remedy);
    }
    if (!in_range(node, path, range, static_cast<double>(*read), std::string(kTypeName<T>))) return false;
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

}  // namespace semfield
