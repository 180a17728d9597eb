// Reads a map of the tree into a parameter struct, strictly, collecting every error.
#include "config/params.h"

#include <algorithm>
#include <array>
#include <charconv>
#include <cmath>
#include <cstdint>
#include <limits>
#include <optional>
#include <system_error>
#include <utility>

#include "config/explain.h"
#include "core/check.h"
#include "core/text.h"

namespace semfield {
namespace {

// The digits of `text` from `at` on, as many as there are.
std::size_t skip_digits(std::string_view text, std::size_t at) {
  while (at < text.size() && is_digit(text[at])) ++at;
  return at;
}

// "007", "-010", "00.5": YAML 1.1 reads some of these as octal, YAML 1.2 as decimal, so none is read.
bool has_leading_zero(std::string_view text) {
  const std::size_t at = !text.empty() && (text[0] == '-' || text[0] == '+') ? 1 : 0;
  return at + 1 < text.size() && text[at] == '0' && is_digit(text[at + 1]);
}

// int = [+-] digits, without leading zeros.
std::optional<std::int64_t> parse_integer(std::string_view text, std::string& remedy) {
  const std::size_t at = !text.empty() && (text[0] == '-' || text[0] == '+') ? 1 : 0;
  if (at == text.size() || skip_digits(text, at) != text.size()) return std::nullopt;
  if (has_leading_zero(text)) {
    remedy = "write it without leading zeros";
    return std::nullopt;
  }
  if (text[0] == '+') text.remove_prefix(1);
  std::int64_t value = 0;
  if (std::from_chars(text.data(), text.data() + text.size(), value).ec != std::errc{}) {
    remedy = "it does not fit 64 bits";
    return std::nullopt;
  }
  return value;
}

// number = [+-] (digits [. digits] | . digits) [e [+-] digits], finite, without leading zeros.
std::optional<double> parse_number(std::string_view text, std::string& remedy) {
  std::size_t at = !text.empty() && (text[0] == '-' || text[0] == '+') ? 1 : 0;
  const std::size_t whole = skip_digits(text, at);
  std::size_t digits = whole - at;
  at = whole;
  if (at < text.size() && text[at] == '.') {
    const std::size_t end = skip_digits(text, at + 1);
    digits += end - at - 1;
    at = end;
  }
  if (digits == 0) {
    const std::string_view bare = text.substr(!text.empty() && (text[0] == '-' || text[0] == '+') ? 1 : 0);
    for (const std::string_view word : {".nan", ".NaN", ".NAN", ".inf", ".Inf", ".INF", "nan", "inf"}) {
      if (bare == word) remedy = "only finite numbers are allowed";
    }
    return std::nullopt;
  }
  if (at < text.size() && (text[at] == 'e' || text[at] == 'E')) {
    const std::size_t sign = at + 1 < text.size() && (text[at + 1] == '-' || text[at + 1] == '+') ? 2 : 1;
    const std::size_t end = skip_digits(text, at + sign);
    if (end == at + sign) return std::nullopt;
    at = end;
  }
  if (at != text.size()) return std::nullopt;
  if (has_leading_zero(text)) {
    remedy = "write it without leading zeros";
    return std::nullopt;
  }
  if (text[0] == '+') text.remove_prefix(1);
  double value = 0;
  if (std::from_chars(text.data(), text.data() + text.size(), value).ec != std::errc{} || !std::isfinite(value)) {
    remedy = "it is beyond the range of a double";
    return std::nullopt;
  }
  return value;
}

class Reader final : public ParamVisitor {
 public:
  Reader(const ConfigNode& node, const std::string& path, Diagnostics& diagnostics)
      : node_(node), path_(path), diagnostics_(diagnostics) {}

  const std::vector<std::string>& seen() const { return seen_; }

  void boolean(const ParamInfo& info, bool& value) override {
    const ConfigNode* node = get(info);
    if (node == nullptr) return;
    if (node->is_scalar() && !node->quoted() && (node->text() == "true" || node->text() == "false")) {
      value = node->text() == "true";
    } else {
      report("config.value.type", *node, key_path(info.name), "bool", kind_text(*node), "write true or false");
    }
  }
  void integer(const ParamInfo& info, std::int64_t& value) override {
    if (const ConfigNode* node = get(info)) read_integer(*node, key_path(info.name), info.range, value);
  }
  void real(const ParamInfo& info, double& value) override {
    if (const ConfigNode* node = get(info)) read_real(*node, key_path(info.name), info.range, value);
  }
  void text(const ParamInfo& info, std::string& value) override {
    if (const ConfigNode* node = get(info)) read_word(*node, key_path(info.name), value);
  }
  void choice(const ParamInfo& info, int& value, std::span<const std::string_view> names) override {
    const ConfigNode* node = get(info);
    if (node == nullptr) return;
    for (std::size_t i = 0; i < names.size(); ++i) {
      if (node->is_scalar() && node->text() == names[i]) {
        value = static_cast<int>(i);
        return;
      }
    }
    const std::vector<std::string> known(names.begin(), names.end());
    const std::string near = node->is_scalar() ? did_you_mean(node->text(), known) : std::string();
    report("config.value.choice", *node, key_path(info.name), "one of " + join(known), kind_text(*node),
           near.empty() ? "" : "did you mean '" + near + "'?");
  }
  void integers(const ParamInfo& info, std::vector<std::int64_t>& value) override {
    read_list(info, "list of int", value, [&](const ConfigNode& item, const std::string& path, std::int64_t& out) {
      return read_integer(item, path, info.range, out);
    });
  }
  void reals(const ParamInfo& info, std::vector<double>& value) override {
    read_list(info, "list of number", value, [&](const ConfigNode& item, const std::string& path, double& out) {
      return read_real(item, path, info.range, out);
    });
  }
  void texts(const ParamInfo& info, std::vector<std::string>& value) override {
    read_list(info, "list of text", value, [&](const ConfigNode& item, const std::string& path, std::string& out) {
      return read_word(item, path, out);
    });
  }

 private:
  const ConfigNode* get(const ParamInfo& info) {
    seen_.emplace_back(info.name);
    return node_.find(info.name);
  }

  std::string key_path(std::string_view key) const {
    return path_.empty() ? std::string(key) : path_ + "." + std::string(key);
  }

  void report(Code code, const ConfigNode& node, const std::string& path, const std::string& expected,
              const std::string& got, const std::string& remedy = {}) {
    diagnostics_.error(code, node.location().text(), path + ": expected " + expected + ", got " + got, remedy);
  }

  // "int in [1, 32]", "int >= 1": a limit of the field's type is named only when it is what the value breaks.
  bool in_range(const ConfigNode& node, const std::string& path, const Range& range, double value, const char* type) {
    if (value >= range.min && value <= range.max) return true;
    Range broken;
    (value < range.min ? broken.min : broken.max) = value < range.min ? range.min : range.max;
    const bool breaks_type_limit = range_text(broken, true).empty();
    const std::string bounds = range_text(range, !breaks_type_limit);
    report("config.value.range", node, path, std::string(type) + (bounds[0] == '[' ? " in " : " ") + bounds,
           node.text());
    return false;
  }

  bool read_integer(const ConfigNode& node, const std::string& path, const Range& range, std::int64_t& value) {
    std::string remedy;
    std::optional<std::int64_t> read;
    if (node.is_scalar() && !node.quoted()) read = parse_integer(node.text(), remedy);
    if (!read) {
      if (node.is_scalar() && node.quoted()) remedy = "numbers stand without quotes";
      report("config.value.type", node, path, "int", kind_text(node), remedy);
      return false;
    }
    if (!in_range(node, path, range, static_cast<double>(*read), "int")) return false;
    value = *read;
    return true;
  }

  bool read_real(const ConfigNode& node, const std::string& path, const Range& range, double& value) {
    std::string remedy;
    std::optional<double> read;
    if (node.is_scalar() && !node.quoted()) read = parse_number(node.text(), remedy);
    if (!read) {
      if (node.is_scalar() && node.quoted()) remedy = "numbers stand without quotes";
      report("config.value.type", node, path, "number", kind_text(node), remedy);
      return false;
    }
    if (!in_range(node, path, range, *read, "number")) return false;
    value = *read;
    return true;
  }

  bool read_word(const ConfigNode& node, const std::string& path, std::string& value) {
    if (!node.is_scalar()) {
      report("config.value.type", node, path, "text", kind_text(node));
      return false;
    }
    value = node.text();
    return true;
  }

  // The list is taken whole or, when an item is wrong, not at all.
  template <class T, class ReadItem>
  void read_list(const ParamInfo& info, const std::string& type, std::vector<T>& value, const ReadItem& read_item) {
    const ConfigNode* node = get(info);
    if (node == nullptr) return;
    if (!node->is_list()) {
      report("config.value.type", *node, key_path(info.name), type, kind_text(*node),
             node->is_scalar() ? "write [" + node->text() + "]" : "");
      return;
    }
    std::vector<T> items;
    bool whole = true;
    for (std::size_t i = 0; i < node->items().size(); ++i) {
      T item{};
      whole = read_item(node->items()[i], key_path(info.name) + "." + std::to_string(i), item) && whole;
      items.push_back(std::move(item));
    }
    if (whole) value = std::move(items);
  }

  const ConfigNode& node_;
  const std::string& path_;
  Diagnostics& diagnostics_;
  std::vector<std::string> seen_;
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
  Reader reader(node, path, diagnostics);
  describe(reader);
  std::vector<std::string> known = reader.seen();
  known.insert(known.end(), other_keys.begin(), other_keys.end());
  refuse_unknown_keys(node, prefix + "unknown key", known, diagnostics);
}

void refuse_unknown_keys(const ConfigNode& map, const std::string& what, const std::vector<std::string>& known,
                         Diagnostics& diagnostics) {
  for (const auto& [key, value] : map.entries()) {
    if (std::find(known.begin(), known.end(), key) != known.end()) continue;
    const std::string near = did_you_mean(key, known);
    std::string remedy = known.empty() ? "there are no keys here" : "known: " + join(known);
    if (!near.empty()) remedy = "did you mean '" + near + "'?";
    diagnostics.error("config.key.unknown", value.key_location().text(), what + " '" + key + "'", remedy);
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

namespace {

ConfigNode number_node(double value) { return ConfigNode::make_scalar(shortest_number(value), false, {}); }
ConfigNode integer_node(std::int64_t value) { return ConfigNode::make_scalar(std::to_string(value), false, {}); }
ConfigNode text_node(const std::string& value) { return ConfigNode::make_scalar(value, !is_plain_text(value), {}); }

class Writer final : public ParamVisitor {
 public:
  ConfigNode take() { return ConfigNode::make_map(std::move(entries_), {}); }

  void boolean(const ParamInfo& info, bool& value) override {
    add(info, ConfigNode::make_scalar(value ? "true" : "false", false, {}));
  }
  void integer(const ParamInfo& info, std::int64_t& value) override { add(info, integer_node(value)); }
  void real(const ParamInfo& info, double& value) override { add(info, number_node(value)); }
  void text(const ParamInfo& info, std::string& value) override { add(info, text_node(value)); }
  void choice(const ParamInfo& info, int& value, std::span<const std::string_view> names) override {
    SEMFIELD_CHECK(value >= 0 && static_cast<std::size_t>(value) < names.size(), "choice outside its names");
    add(info, text_node(std::string(names[static_cast<std::size_t>(value)])));
  }
  void integers(const ParamInfo& info, std::vector<std::int64_t>& value) override {
    add_list(info, value, integer_node);
  }
  void reals(const ParamInfo& info, std::vector<double>& value) override { add_list(info, value, number_node); }
  void texts(const ParamInfo& info, std::vector<std::string>& value) override { add_list(info, value, text_node); }

 private:
  void add(const ParamInfo& info, ConfigNode node) { entries_.emplace_back(std::string(info.name), std::move(node)); }

  template <class T, class ToNode>
  void add_list(const ParamInfo& info, const std::vector<T>& values, const ToNode& to_node) {
    std::vector<ConfigNode> items;
    items.reserve(values.size());
    for (const T& value : values) items.push_back(to_node(value));
    add(info, ConfigNode::make_list(std::move(items), {}));
  }

  std::vector<ConfigNode::Entry> entries_;
};

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
  Writer writer;
  describe(writer);
  return writer.take();
}

// Parameters as rows of text: help, reference page, schema.

namespace {

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

class Describer final : public ParamVisitor {
 public:
  std::vector<ParamDoc> take() { return std::move(docs_); }

  void boolean(const ParamInfo& info, bool&) override { add(info, "bool"); }
  void integer(const ParamInfo& info, std::int64_t&) override { add(info, "int"); }
  void real(const ParamInfo& info, double&) override { add(info, "number"); }
  void text(const ParamInfo& info, std::string&) override { add(info, "text"); }
  void choice(const ParamInfo& info, int&, std::span<const std::string_view> names) override {
    add(info, "choice").choices.assign(names.begin(), names.end());
  }
  void integers(const ParamInfo& info, std::vector<std::int64_t>&) override { add(info, "list of int"); }
  void reals(const ParamInfo& info, std::vector<double>&) override { add(info, "list of number"); }
  void texts(const ParamInfo& info, std::vector<std::string>&) override { add(info, "list of text"); }

 private:
  ParamDoc& add(const ParamInfo& info, const char* type) {
    ParamDoc doc;
    doc.name = info.name;
    doc.type = type;
    doc.help = info.help;
    doc.limits = info.range;
    if (is_type_limit(doc.limits.min, false)) doc.limits.min = -std::numeric_limits<double>::infinity();
    if (is_type_limit(doc.limits.max, true)) doc.limits.max = std::numeric_limits<double>::infinity();
    doc.range = range_text(doc.limits, true);
    docs_.push_back(std::move(doc));
    return docs_.back();
  }

  std::vector<ParamDoc> docs_;
};

}  // namespace

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
  Describer describer;
  describe(describer);
  std::vector<ParamDoc> docs = describer.take();
  const ConfigNode values = params_to_config(describe);
  for (ParamDoc& doc : docs) {
    if (const ConfigNode* value = values.find(doc.name)) doc.default_value = write_config_inline(*value);
  }
  return docs;
}

}  // namespace semfield
