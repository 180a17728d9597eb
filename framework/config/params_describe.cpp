// Parameters as rows of text: help, reference page, schema.
#include <cmath>
#include <cstdint>
#include <limits>

#include "config/params_read.h"

namespace semfield {
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
