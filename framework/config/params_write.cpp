// The values of a parameter struct as a tree, for the resolved config.
#include <algorithm>
#include <array>
#include <charconv>
#include <cmath>

#include "config/params_read.h"
#include "core/check.h"

namespace semfield {
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

}  // namespace semfield
