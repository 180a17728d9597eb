// Parameters, traits and registration of the frequency encoder.
#include "encoders/frequency/frequency.h"

#include <algorithm>
#include <cmath>
#include <cstdio>

#include "plugin/module.h"
#include "plugin/registry.h"

namespace semfield {

void describe(ParamVisitor& visit, FrequencyParams& p) {
  SEMFIELD_PARAM(visit, p, frequencies, "L, number of bands [Mildenhall20 Eq. 4]", {0, 40});
  SEMFIELD_PARAM(visit, p, include_input, "put the coordinates themselves before the bands");
  SEMFIELD_PARAM(visit, p, angular, "angle of band k: 2^k x (radian) or 2^k pi x (pi)");
  SEMFIELD_PARAM(visit, p, arithmetic,
                 "what is rounded to fp32, for comparisons: nothing, the coordinates, or the angles too (naive)");
}

void validate(const FrequencyParams& p, Diagnostics& diagnostics) {
  if (p.frequencies == 0 && !p.include_input) {
    diagnostics.error("config.encoder.empty", "frequencies", "0 bands without the input leave nothing to encode",
                      "set include_input: true or frequencies to at least 1");
  }
}

int effective_bands(double delta_x, Angular angular) {
  if (!(delta_x > 0) || !std::isfinite(delta_x)) {
    throw Error(ErrorKind::config, "config.value.range",
                "effective bands need a positive, finite coordinate error, got " + std::to_string(delta_x),
                "give the rounding or measurement error of the coordinates");
  }
  return std::max(0, static_cast<int>(std::floor(std::log2(0.1 / (angular_factor(angular) * delta_x)))));
}

double coordinate_error(Arithmetic arithmetic, Angular angular, double largest) {
  switch (arithmetic) {
    case Arithmetic::float64:
      return 0x1p-53 * largest;
    case Arithmetic::float32:
      return 0x1p-24 * largest;
    case Arithmetic::naive:
      return (angular == Angular::pi ? 0x1p-23 : 0x1p-24) * largest;
  }
  return largest;
}

void choose(FrequencyParams& p, const EncoderBuild& build, std::vector<std::string>& chosen) {
  if (!(build.largest_coordinate > 0)) return;
  const double error = coordinate_error(p.arithmetic, p.angular, build.largest_coordinate);
  const int bands = effective_bands(error, p.angular);
  if (p.frequencies <= bands) return;
  char text[320];
  std::snprintf(
      text, sizeof text,
      "warning: effective_bands is %d of %d: coordinates up to %.3g are known to within %.2g, so the %d highest "
      "bands are noise; %s",
      bands, p.frequencies, build.largest_coordinate, error, p.frequencies - bands,
      p.arithmetic == Arithmetic::float64 ? "lower frequencies or rendering.scene_scale"
                                          : "set arithmetic: float64, or lower frequencies");
  chosen.emplace_back(text);
}

SEMFIELD_PLUGIN_MODULE(frequency, "1.0", [](Registry& registry) {
  frequency_kernels(registry.kernels());
  registry.add_encoder<Frequency, FrequencyParams>(
      "frequency", "Sines and cosines of the coordinates at doubling frequencies, exact at every band.");
})

}  // namespace semfield
