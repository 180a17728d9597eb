// Parameters, traits and registration of the frequency encoder.
#include "encoders/frequency/frequency.h"

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <string>

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
  const double a = angular == Angular::pi ? 3.141592653589793 : 1.0;
  return std::max(0, static_cast<int>(std::floor(std::log2(0.1 / (a * delta_x)))));
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

namespace {
EncoderTraits traits_of(const FrequencyParams& p, std::int32_t dims) {
  return {dims, dims * (2 * p.frequencies + (p.include_input ? 1 : 0)), Domain::metric};
}
}  // namespace

template <class Real>
Frequency<Real>::Frequency(const FrequencyParams& p, const EncoderBuild& build, const KernelTables& kernels)
    : RowEncoder<Real, FrequencyShape>(build, kernels, "encoder 'frequency'", traits_of(p, build.in_dims),
                                       {build.in_dims, p.frequencies, p.include_input, p.angular, p.arithmetic}) {
  if (build.in_dims < 1 || build.in_dims > kFrequencyMaxDims) {
    throw Error(ErrorKind::config, "config.encoder.inputs",
                "encoder 'frequency' takes 1 to " + std::to_string(kFrequencyMaxDims) + " coordinates, got " +
                    std::to_string(build.in_dims));
  }
}

template <class Real>
Error Frequency<Real>::refused(View<const double>, std::int64_t row) const {
  return {ErrorKind::data, "scene.coordinates.not_finite",
          "encoder 'frequency': coordinates of row " + std::to_string(row) +
              " are not finite or farther than 2^30 from the origin",
          "check the camera poses, the scene scale and the ray limits"};
}

template class Frequency<float>;
template class Frequency<double>;

SEMFIELD_PLUGIN_MODULE(frequency, "1.0", [](Registry& registry) {
  frequency_kernels(registry.kernels());
  registry.add_encoder<Frequency, FrequencyParams>(
      "frequency", "Sines and cosines of the coordinates at doubling frequencies, exact at every band.");
})

}  // namespace semfield
