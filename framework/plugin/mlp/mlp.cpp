// Builds the graph of a network: which layers are needed, their tensors, and products of linear layers.
#include "plugin/mlp/mlp.h"

#include <algorithm>
#include <cmath>

#include "core/check.h"

namespace semfield {

template <class Real>
Mlp<Real>::Mlp(const MlpBuild& build, const KernelTables& kernels, std::string_view owner)
    : kernels_(&kernels.get<MlpKernels<Real>>(build.device, owner, build.precision)), build_(build) {
  graph_.precision = build.precision;
  graph_.rays_once = build.rays_once;
  graph_.sample_dims = build.sample_dims;
  graph_.ray_dims = build.ray_dims;
}

template <class Real>
Rows Mlp<Real>::layer(const LayerSpec& spec) {
  MlpLayer layer;
  layer.name = spec.name;
  layer.width = spec.width;
  layer.activation = spec.activation;
  layer.frequency = spec.frequency;
  for (const Rows& from : spec.inputs) {
    if (!from.empty()) layer.parts.push_back({from, {}});
  }
  graph_.layers.push_back(layer);
  return {kFirstLayer + static_cast<int>(graph_.layers.size()) - 1, 0, spec.width};
}

template <class Real>
Rows Mlp<Real>::chain(const LayerSpec& spec, int count, int skip_at) {
  Rows last;
  for (int i = 0; i < count; ++i) {
    LayerSpec one = spec;
    one.name += "_" + std::to_string(i);
    if (i > 0 && i != skip_at) one.inputs.clear();
    if (i > 0) one.inputs.push_back(last);
    last = layer(one);
  }
  return last;
}

template <class Real>
void Mlp<Real>::output(Rows rows) {
  graph_.outputs.push_back(rows);
}

template <class Real>
void Mlp<Real>::seal() {
  drop_unneeded();
  for (const Rows& out : graph_.outputs) {
    if (out.empty()) continue;
    MlpLayer& layer = graph_.layers[static_cast<std::size_t>(out.node - kFirstLayer)];
    layer.exact = layer.activation == LayerActivation::none || layer.activation == LayerActivation::sigmoid;
    SEMFIELD_CHECK(layer.activation == LayerActivation::none || out.cols == layer.width,
                   "an output is a whole layer, or columns of one without activation");
  }
  declare_layers(graph_.layers);
  if (build_.fold) multiply_linear_pairs();
  for (const MlpLayer& layer : graph_.layers) {
    for (const MlpPart& part : layer.parts) {
      if (part.from.node < kFirstLayer) continue;
      MlpLayer& from = graph_.layers[static_cast<std::size_t>(part.from.node - kFirstLayer)];
      SEMFIELD_CHECK(from.activation != LayerActivation::sigmoid, "no layer reads the sigmoid of an output");
      SEMFIELD_CHECK(from.exact ? from.read.empty() || from.read == part.from : part.from.cols == from.width,
                     "layers read a hidden layer as a whole, and the same columns of an output");
      if (from.exact) from.read = part.from;
    }
  }
  int number = 0;
  for (MlpLayer& layer : graph_.layers) {
    for (MlpPart& part : layer.parts) part.number = number++;
  }
  SEMFIELD_CHECK(number <= kMostMlpParts, "a network has too many layers");
  if (build_.device == Device::cpu) rearrange_weights();
}

template <class Real>
void Mlp<Real>::drop_unneeded() {
  std::vector<MlpLayer>& layers = graph_.layers;
  std::vector<bool> needed(layers.size() + kFirstLayer, false);
  for (const Rows& out : graph_.outputs) {
    if (!out.empty()) needed[static_cast<std::size_t>(out.node)] = true;
  }
  for (std::size_t i = layers.size(); i-- > 0;) {
    for (const MlpPart& part : layers[i].parts) {
      if (needed[i + kFirstLayer]) needed[static_cast<std::size_t>(part.from.node)] = true;
    }
  }
  std::vector<int> number(needed.size(), -1);
  std::vector<MlpLayer> kept;
  number[kSampleInput] = kSampleInput, number[kRayInput] = kRayInput;
  for (std::size_t i = 0; i < layers.size(); ++i) {
    if (!needed[i + kFirstLayer]) continue;
    number[i + kFirstLayer] = kFirstLayer + static_cast<int>(kept.size());
    kept.push_back(layers[i]);
    for (MlpPart& part : kept.back().parts) part.from.node = number[static_cast<std::size_t>(part.from.node)];
  }
  for (Rows& out : graph_.outputs) {
    if (!out.empty()) out.node = number[static_cast<std::size_t>(out.node)];
  }
  layers = std::move(kept);
  SEMFIELD_CHECK(layers.size() <= kMostMlpLayers && graph_.outputs.size() <= kMostMlpOutputs,
                 "a network has too many layers or outputs");
}

template <class Real>
void Mlp<Real>::declare_layers(std::vector<MlpLayer>& layers) {
  const auto tensor = [&](const std::string& name, std::int64_t rows, std::int32_t cols, double bound) {
    specs_.push_back({name, rows, cols, Init::uniform(bound), TensorRole::dense});
    return static_cast<int>(specs_.size()) - 1;
  };
  for (MlpLayer& layer : layers) {
    std::int32_t in = 0;
    bool first = false;
    for (MlpPart& part : layer.parts) {
      part.weight.first = in;
      part.weight.rows = part.from.cols;
      part.weight.cols = layer.width;
      in += part.from.cols;
      first = first || part.from.node == kSampleInput;
    }
    SEMFIELD_CHECK(std::any_of(layer.parts.begin(), layer.parts.end(),
                               [](const MlpPart& part) { return part.from.node != kRayInput; }),
                   "a layer reads at least one row per sample");
    const double of_inputs = 1 / std::sqrt(static_cast<double>(in));
    const double of_sine = first ? 1.0 / in : std::sqrt(6.0 / in) / layer.frequency;
    layer.weight = tensor(layer.name + "/weight", in, layer.width,
                          layer.activation == LayerActivation::sine ? of_sine : of_inputs);
    layer.bias = tensor(layer.name + "/bias", 1, layer.width, of_inputs);
    for (MlpPart& part : layer.parts) part.weight.weight = layer.weight;
  }
}

// A linear layer of one input that one layer alone reads, and that is no output, becomes a factor of that layer.
template <class Real>
void Mlp<Real>::multiply_linear_pairs() {
  for (std::size_t i = 0; i < graph_.layers.size(); ++i) {
    const MlpLayer linear = graph_.layers[i];
    if (linear.activation != LayerActivation::none || linear.exact || linear.parts.size() != 1) continue;
    MlpLayer* reader = nullptr;
    int readers = 0;
    for (MlpLayer& layer : graph_.layers) {
      for (const MlpPart& part : layer.parts) {
        if (part.from.node != kFirstLayer + static_cast<int>(i)) continue;
        ++readers;
        reader = &layer;
      }
    }
    if (readers != 1 || reader->fold >= 0 || reader->parts[0].from.node != kFirstLayer + static_cast<int>(i)) continue;
    MlpPart& part = reader->parts[0];
    MlpFold fold;
    fold.in = linear.parts[0].from.cols, fold.mid = linear.width, fold.out = reader->width;
    fold.first_weight = linear.weight, fold.first_bias = linear.bias;
    fold.second_weight = reader->weight, fold.second_bias = reader->bias;
    fold.second = part.weight;
    const std::string name = "folded" + (graph_.folds.empty() ? "" : "_" + std::to_string(graph_.folds.size()));
    fold.weight = static_cast<int>(specs_.size());
    specs_.push_back({name + "/weight", fold.in, fold.out, {}, TensorRole::derived});
    fold.bias = static_cast<int>(specs_.size());
    specs_.push_back({name + "/bias", 1, fold.out, {}, TensorRole::derived});
    part.from = linear.parts[0].from;
    part.weight = {.weight = fold.weight, .rows = fold.in, .cols = fold.out};
    reader->bias = fold.bias;
    reader->fold = static_cast<int>(graph_.folds.size());
    graph_.folds.push_back(fold);
    graph_.layers[i].parts.clear();  // it is computed no more
  }
}

// What a CPU's kernels read of the weights.
template <class Real>
void Mlp<Real>::rearrange_weights() {
  for (MlpLayer& layer : graph_.layers) {
    for (MlpPart& part : layer.parts) {
      const LayerWeight& w = part.weight;
      if (part.from.node != kRayInput)
        part.weight = rearranged_weight(specs_, w.weight, w.first, w.rows, graph_.precision);
    }
  }
  // In the arithmetic of derive.
  for (MlpFold& fold : graph_.folds)
    fold.second = rearranged_weight(specs_, fold.second_weight, fold.second.first, fold.mid, Precision::fp32);
}

template <class Real>
const MlpLayer* Mlp<Real>::find(std::string_view name) const {
  const auto at = std::find_if(graph_.layers.begin(), graph_.layers.end(),
                               [&](const MlpLayer& layer) { return layer.name == name; });
  return at == graph_.layers.end() ? nullptr : &*at;
}

template <class Real>
void Mlp<Real>::declare(ParamDeclarer& declarer) const {
  for (const TensorSpec& spec : specs_) declarer.tensor(spec);
}

template <class Real>
std::vector<LayerShape> Mlp<Real>::layers() const {
  std::vector<LayerShape> list;
  for (const MlpLayer& layer : graph_.layers) {
    if (layer.fold >= 0) {
      // The product of the two weights, and of a bias with the second.
      const MlpFold& fold = graph_.folds[static_cast<std::size_t>(layer.fold)];
      list.push_back({"folded", fold.mid, fold.out, LayerRows::step, LayerInput::activation, fold.in + 1});
    }
    for (const MlpPart& part : layer.parts) {
      const bool of_ray = part.from.node == kRayInput;
      list.push_back({layer.name, part.from.cols, layer.width,
                      of_ray && graph_.rays_once ? LayerRows::ray : LayerRows::sample,
                      of_ray                           ? LayerInput::direction
                      : part.from.node == kSampleInput ? LayerInput::position
                                                       : LayerInput::activation});
    }
  }
  return list;
}

template class Mlp<float>;
template class Mlp<double>;

}  // namespace semfield
