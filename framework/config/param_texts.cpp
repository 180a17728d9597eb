// Parameters written: their values as a tree, for the resolved configuration, and as rows of text for help, reference
// page and schema.
#include <array>
#include <charconv>
#include <cmath>

#include "config/params.h"
#include "core/check.h"

namespace semfield {
namespace {

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
    doc.type = kTypeName<T>;
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
