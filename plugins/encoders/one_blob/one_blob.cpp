// Parameters, traits and registration of the one-blob encoder.
#include "encoders/one_blob/one_blob.h"

#include "core/check.h"
#include "plugin/module.h"
#include "plugin/registry.h"

namespace semfield {

void describe(ParamVisitor& visit, OneBlobParams& p) {
  SEMFIELD_PARAM(visit, p, bins, "k, values per coordinate; the blob's standard deviation is 1/k [Mueller19 Sec. 4.3]",
                 {2, kOneBlobMaxBins});
}

template <class Real>
OneBlob<Real>::OneBlob(const OneBlobParams& p, const EncoderBuild& build, const KernelTables& kernels)
    : RowEncoder<Real, OneBlobShape>(build, kernels, "encoder 'one_blob'",
                                     {kOneBlobDims, kOneBlobDims * p.bins, Domain::unit_cube}, {p.bins}) {
  SEMFIELD_CHECK(p.bins >= 2 && p.bins <= kOneBlobMaxBins, "the range is checked while reading");
}

template class OneBlob<float>;
template class OneBlob<double>;

SEMFIELD_PLUGIN_MODULE(one_blob, "1.0", [](Registry& registry) {
  one_blob_kernels(registry.kernels());
  registry.add_encoder<OneBlob, OneBlobParams>(
      "one_blob", "A Gaussian about each coordinate of the unit cube, read at the middles of bins.");
})

}  // namespace semfield
