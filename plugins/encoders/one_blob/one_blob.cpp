// Parameters, traits and registration of the one-blob encoder.
#include "encoders/one_blob/one_blob.h"

#include "plugin/module.h"
#include "plugin/registry.h"

namespace semfield {

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
