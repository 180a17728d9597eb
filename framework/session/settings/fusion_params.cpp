#include "session/settings/fusion_params.h"

#include <algorithm>
#include <cmath>

namespace semfield {

void describe(ParamVisitor& visit, FusionParams& p) {
  SEMFIELD_PARAM(visit, p, methods, "what is computed: monocular (a view's own prediction), bayesian, average");
  SEMFIELD_PARAM(visit, p, depth,
                 "depth that locates a point in other views: the scene's own, or that of a run's field");
  SEMFIELD_PARAM(visit, p, min_opacity, "learned depth: opacity of a rendered pixel below which it has no depth",
                 {0.01, 1});
  SEMFIELD_PARAM(visit, p, tolerance,
                 "length by which the depth of a point and of a view may differ; beyond it the point is hidden; 0: "
                 "1 cm, or 1/500 of the longest side of a scene that is no room in metres",
                 {0, 1e12});
  SEMFIELD_PARAM(visit, p, relative_tolerance, "share of the point's depth that is added to tolerance", {0, 1});
  SEMFIELD_PARAM(visit, p, floor, "bayesian: least probability of a class in one view", {1e-12, 0.5});
  SEMFIELD_PARAM(visit, p, views, "other views asked for each frame; 0: all", {0, 1e6});
  SEMFIELD_PARAM(visit, p, choose,
                 "which views are asked when `views` is not 0: those of the nearest cameras, or evenly spaced frames");
  SEMFIELD_PARAM(
      visit, p, neighbourhood,
      "side of the window of pixels whose predictions are averaged in another view; odd; 1: the nearest pixel",
      {1, 15});
  SEMFIELD_PARAM(visit, p, hard_confidence,
                 "probability of the label in a prediction without probabilities; other classes share the rest",
                 {1e-3, 1});
}

void validate(const FusionParams& p, Diagnostics& diagnostics) {
  if (p.neighbourhood % 2 == 0) {
    diagnostics.error("config.value.range", "fuse.neighbourhood",
                      "a window of " + std::to_string(p.neighbourhood) + " pixels has no centre",
                      "write an odd number");
  }
  if (p.methods.empty())
    diagnostics.error("config.value.missing", "fuse.methods", "no method is named", "write for example [bayesian]");
  try {
    (void)fusion_methods(p.methods);
  } catch (const Error& e) {
    diagnostics.error(e.code(), "", e.message(), e.remedy());
  }
}

bool FusionParams::agree(double a, double b) const { return std::abs(a - b) <= tolerance + relative_tolerance * a; }

std::string_view fusion_method_name(FusionMethod method) {
  return ChoiceNames<FusionMethod>::names[static_cast<std::size_t>(method)];
}

std::vector<FusionMethod> fusion_methods(const std::vector<std::string>& names) {
  constexpr auto& known = ChoiceNames<FusionMethod>::names;
  std::vector<FusionMethod> out;
  for (const std::string& name : names) {
    const auto found = std::find(known.begin(), known.end(), name);
    if (found == known.end()) {
      const std::vector<std::string> all(known.begin(), known.end());
      const std::string near = did_you_mean(name, all);
      throw Error(ErrorKind::config, "config.value.choice", "fuse.methods: there is no method '" + name + "'",
                  near.empty() ? "known: " + join(all) : "did you mean '" + near + "'?");
    }
    const auto method = static_cast<FusionMethod>(found - known.begin());
    if (std::find(out.begin(), out.end(), method) == out.end()) out.push_back(method);
  }
  return out;
}

}  // namespace semfield
