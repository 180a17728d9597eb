// One-blob encoding of positions: a Gaussian about each coordinate, read at the middles of k bins of [0, 1].
#include "config/params.h"
#include "core/check.h"
#include "encoders/one_blob/one_blob_kernels.h"
#include "plugin/encoder.h"
#include "plugin/kernels.h"
#include "plugin/module.h"
#include "plugin/registry.h"

namespace semfield {

struct OneBlobParams {
  int bins = 16;
};

/// y [M, 3 k], k bins: column c k + b = exp(-z^2 / 2), z = (b + 1/2) - k x_c, the middle of bin b seen from coordinate
/// c in standard deviations of 1 / k. x [M, 3] float64 in the unit cube; outside it is clamped (and dx is 0 along that
/// axis; on a face dx is the slope towards the inside); not finite is Error(data) naming the row. Error of a value:
/// 1.2e-7 in float, 2.4e-15 in double; values below 1.7e-38 (float) and 3.4e-308 (double) are 0. [Mueller19 Sec. 4.3]
template <class Real>
class OneBlob final : public RowEncoder<Real, OneBlobShape> {
 public:
  OneBlob(const OneBlobParams& p, const EncoderBuild& build, const KernelTables& kernels)
      : RowEncoder<Real, OneBlobShape>(build, kernels, "encoder 'one_blob'",
                                       {kOneBlobDims, kOneBlobDims * p.bins, Domain::unit_cube}, {p.bins}) {
    SEMFIELD_CHECK(p.bins >= 2 && p.bins <= kOneBlobMaxBins, "the range is checked while reading");
  }
};

void describe(ParamVisitor& visit, OneBlobParams& p) {
  SEMFIELD_PARAM(visit, p, bins, "k, values per coordinate; the blob's standard deviation is 1/k [Mueller19 Sec. 4.3]",
                 {2, kOneBlobMaxBins});
}

SEMFIELD_PLUGIN_MODULE(one_blob, "1.0", [](Registry& registry) {
  one_blob_kernels(registry.kernels());
  registry.add_encoder<OneBlob, OneBlobParams>(
      "one_blob", "A Gaussian about each coordinate of the unit cube, read at the middles of bins.");
})

}  // namespace semfield
