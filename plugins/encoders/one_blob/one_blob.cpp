// Parameters, traits and registration of the one-blob encoder.
#include "encoders/one_blob/one_blob.h"

#include <string>

#include "core/check.h"
#include "plugin/module.h"
#include "plugin/registry.h"

namespace semfield {

void describe(ParamVisitor& visit, OneBlobParams& p) {
  SEMFIELD_PARAM(visit, p, bins, "k, values per coordinate; the blob's standard deviation is 1/k [Mueller19 Sec. 4.3]",
                 {2, kOneBlobMaxBins});
}

void validate(const OneBlobParams&, Diagnostics&) {}

template <class Real>
OneBlob<Real>::OneBlob(const OneBlobParams& params, const EncoderBuild& build, const KernelTables& kernels)
    : kernels_(&kernels.get<OneBlobKernels<Real>>(build.device, "encoder 'one_blob'")), bins_(params.bins) {
  if (build.in_dims != kOneBlobDims) {
    throw Error(ErrorKind::config, "config.encoder.inputs",
                "encoder 'one_blob' takes 3 coordinates, got " + std::to_string(build.in_dims));
  }
  SEMFIELD_CHECK(bins_ >= 2 && bins_ <= kOneBlobMaxBins, "the range is checked while reading");
}

template <class Real>
EncoderTraits OneBlob<Real>::traits() const noexcept {
  return {kOneBlobDims, kOneBlobDims * bins_, Domain::unit_cube};
}

template <class Real>
void OneBlob<Real>::do_forward(const StepContext&, const Tensors<Real>&, View<const double> x, View<Real> y) const {
  const std::int64_t bad = kernels_->forward(bins_, x, y);
  if (bad >= 0) {
    throw Error(ErrorKind::data, "scene.coordinates.not_finite",
                "encoder 'one_blob': coordinates of row " + std::to_string(bad) + " are not finite",
                "check the camera poses and the ray limits");
  }
}

template <class Real>
void OneBlob<Real>::do_backward(const StepContext&, const Tensors<Real>&, View<const double> x, View<const Real> dy,
                                View<Real> dx) const {
  if (!dx.empty()) kernels_->backward(bins_, x, dy, dx);
}

template class OneBlob<float>;
template class OneBlob<double>;

SEMFIELD_PLUGIN_MODULE(one_blob, "1.0", [](Registry& registry) {
  one_blob_kernels(registry.kernels());
  registry.add_encoder<OneBlob, OneBlobParams>(
      "one_blob", "A Gaussian about each coordinate of the unit cube, read at the middles of bins.");
})

}  // namespace semfield
