// The section `fuse`: how labels of several views are combined. Declared here, where sections are read; used in
// surface/fuse/.
#pragma once

#include <array>
#include <cstdint>
#include <string>
#include <string_view>
#include <vector>

#include "config/params.h"
#include "core/error.h"

namespace semfield {

enum class FusionMethod : std::uint8_t { monocular, bayesian, average };
template <>
struct ChoiceNames<FusionMethod> {
  static constexpr std::array<std::string_view, 3> names{"monocular", "bayesian", "average"};
};

enum class FusionDepth : std::uint8_t { truth, learned };
template <>
struct ChoiceNames<FusionDepth> {
  static constexpr std::array<std::string_view, 2> names{"true", "learned"};
};

enum class ViewChoice : std::uint8_t { nearest, even };
template <>
struct ChoiceNames<ViewChoice> {
  static constexpr std::array<std::string_view, 2> names{"nearest", "even"};
};

struct FusionParams {
  std::vector<std::string> methods{"monocular", "bayesian", "average"};
  FusionDepth depth = FusionDepth::truth;
  double min_opacity = 0.5;
  double tolerance = 0;
  double relative_tolerance = 0;
  double floor = 1e-4;
  int views = 0;
  ViewChoice choose = ViewChoice::nearest;
  int neighbourhood = 1;
  double hard_confidence = 0.7;

  /// Depths `a` and `b` belong to one surface: |a - b| <= tolerance + relative_tolerance * a.
  bool agree(double a, double b) const;
};
void describe(ParamVisitor& visit, FusionParams& params);
void validate(const FusionParams& params, Diagnostics& diagnostics);

/// Methods by name, each once, in the order given. Throws Error(config) naming one that does not exist.
std::vector<FusionMethod> fusion_methods(const std::vector<std::string>& names);
std::string_view fusion_method_name(FusionMethod method);

}  // namespace semfield
