// The fused CUDA kernels of the NeRF network, as the field finds them.
#include "fields/nerf_mlp/nerf_mlp_fused.h"
#include "plugin/kernels.h"

namespace semfield::cuda {

void nerf_mlp_cuda_kernels(KernelTables& tables);

namespace {

FeatureForm feature_form(const NerfMlpShape&, std::int32_t hidden_width) {
  return FusedNerfMlp::computes_layer(hidden_width) ? FeatureForm::hidden_layer : FeatureForm::rounded;
}

constexpr NerfMlpFused<float> kFused{FusedNerfMlp::serves, FusedNerfMlp::forward, FusedNerfMlp::backward,
                                     FusedNerfMlp::saved_bytes, feature_form};

}  // namespace

void nerf_mlp_cuda_kernels(KernelTables& tables) {
  tables.add(Device::cuda, "field 'nerf_mlp'", &kFused, Precision::bf16);
}

}  // namespace semfield::cuda
