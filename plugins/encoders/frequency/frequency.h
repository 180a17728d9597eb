// Positional encoding with exact range reduction: [x, sin 2^k x, cos 2^k x], k = 0 .. L-1.
#pragma once

#include <string>
#include <vector>

#include "config/params.h"
#include "core/error.h"
#include "encoders/frequency/frequency_kernels.h"
#include "plugin/encoder.h"
#include "plugin/kernels.h"

namespace semfield {

struct FrequencyParams {
  int frequencies = 10;
  bool include_input = true;
  Angular angular = Angular::radian;
  Arithmetic arithmetic = Arithmetic::float64;
};

SEMFIELD_CHOICES(Angular, "radian", "pi");

SEMFIELD_CHOICES(Arithmetic, "float64", "float32", "naive");

void describe(ParamVisitor& visit, FrequencyParams& params);
void validate(const FrequencyParams& params, Diagnostics& diagnostics);

/// How many bands carry information when coordinates are known to within `delta_x` (in the encoder's own units): band k
/// turns an error delta_x into a phase error a 2^k delta_x, and bands up to a phase error of 0.1 rad count:
/// floor(log2(0.1 / (a delta_x))), a = 1 (radian) or pi; at least 0. About 19 for an fp32 coordinate near 1 with a =
/// pi, 48 for float64. Bands above are noise. Throws Error(config) unless delta_x is positive and finite.
int effective_bands(double delta_x, Angular angular);

/// What rounding leaves unknown of a coordinate of magnitude `largest`, in the encoder's units: half a unit in the last
/// place of the precision that `arithmetic` keeps it in. A naive angle 2^k pi x has its factor and its product rounded
/// as well, which about doubles the error (2^k x is exact).
double coordinate_error(Arithmetic arithmetic, Angular angular, double largest);

/// A sentence for a run with more bands than effective_bands(coordinate_error(...), angular): those above are noise.
void choose(FrequencyParams& params, const EncoderBuild& build, std::vector<std::string>& chosen);

/// Layout of a row of y, D = in_dims: [x (D) when include_input, then for k = 0 .. L-1: sin(a 2^k x) (D), cos(a 2^k x)
/// (D)]. a = 1 (radian, the paper's) or pi. x [M, D] float64; |x| at most 2^30, else (or NaN) Error(data) naming the
/// row. Error of a value: 1.2e-7 in float for every band up to k = 39 and |x| up to 2^20; in double 2e-16 for phases
/// 2^k |x| up to 2^30, growing to 1e-14 at 2^59 (the reciprocal of 2 pi is kept to 107 bits). [Mildenhall20 Eq. 4]
/// These bounds hold for Arithmetic::float64; the other two exist to measure what rounding costs.
template <class Real>
class Frequency final : public RowEncoder<Real, FrequencyShape> {
 public:
  Frequency(const FrequencyParams& p, const EncoderBuild& build, const KernelTables& kernels)
      : RowEncoder<Real, FrequencyShape>(
            build, kernels, "encoder 'frequency'",
            {build.in_dims, build.in_dims * (2 * p.frequencies + (p.include_input ? 1 : 0)), Domain::metric},
            {build.in_dims, p.frequencies, p.include_input, p.angular, p.arithmetic}) {
    if (build.in_dims < 1 || build.in_dims > kFrequencyMaxDims) {
      throw Error(ErrorKind::config, "config.encoder.inputs",
                  "encoder 'frequency' takes 1 to " + std::to_string(kFrequencyMaxDims) + " coordinates, got " +
                      std::to_string(build.in_dims));
    }
  }

 protected:
  Error refused(View<const double>, std::int64_t row) const override {
    return {ErrorKind::data, "scene.coordinates.not_finite",
            "encoder 'frequency': coordinates of row " + std::to_string(row) +
                " are not finite or farther than 2^30 from the origin",
            "check the camera poses, the scene scale and the ray limits"};
  }
};

}  // namespace semfield
