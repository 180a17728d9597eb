// Cases D08, D09 and D11: class logits of rays that are empty, half opaque, or may not move the density.
#include <fmt/format.h>

#include <algorithm>
#include <cstring>

#include "encoder_box.h"
#include "loss_cases.h"
#include "losses/semantic_cross_entropy.h"
#include "plugin/head.h"
#include "tests/model_compositor/rays_of_slabs.h"
#include "training_box.h"

namespace semfield::numerics {

namespace {

constexpr std::int32_t kClasses = 28, kHidden = 8;
constexpr std::int16_t kLabel = 5;

/// One ray with a semantic head behind it: hidden activations to a loss, and back to the densities.
template <class Real>
struct SemanticRay {
  explicit SemanticRay(int samples)
      : head(HeadShape{4, kHidden, kClasses}),
        box(head, 3, 0.0),
        rays({samples}, kHidden),
        logits(kClasses),
        slope(kClasses) {
    rays.space_evenly(samples * 0.75);
    Numbers numbers(41);
    for (Real& h : rays.hidden) h = static_cast<Real>(numbers.in(0, 2));
    ctx.workspace = &workspace;
    head.derive(ctx, box.tensors());
  }
  View<Real> weight() { return box.value(2); }
  View<Real> bias() { return box.value(3); }

  double loss() {
    rays.forward();
    head.output_forward(ctx, box.tensors(), {rays.out_hidden.data(), 1, kHidden}, {rays.opacity.data(), 1, 1},
                        row_of(logits));
    SemanticTargets targets{.hard = {&kLabel, 1, 1}};
    return semantic_cross_entropy<Real>(row_of(std::as_const(logits)), targets, {}, 1.0, 1.0, row_of(slope)).sum;
  }
  void backward() {
    std::fill(rays.g_color.begin(), rays.g_color.end(), Real(0));
    head.output_backward(ctx, box.tensors(), {rays.out_hidden.data(), 1, kHidden}, {rays.opacity.data(), 1, 1},
                         row_of(std::as_const(slope)), {rays.g_hidden.data(), 1, kHidden},
                         {rays.g_opacity.data(), 1, 1});
    rays.backward();
  }

  OneLayerHead<Real> head;
  testkit::TensorBox<Real> box;
  testing::RayBuffers<Real> rays;
  std::vector<Real> logits, slope;
  Workspace workspace;
  StepContext ctx;
};

}  // namespace

void empty_ray(CaseRun& run) {
  in_both_precisions(run, [&]<class Real>(Real) {
    SemanticRay<Real> ray(6);  // density 0
    const double loss = ray.loss();
    for (const Real s : ray.logits) run.measure(std::abs(s), 0, "logit");
    std::vector<Real> p(kClasses);
    softmax<Real>(row_of(std::as_const(ray.logits)), row_of(p));
    for (const Real one : p) run.measure(std::abs(one - Real(1) / Real(kClasses)), 0, "probability 1/C");
    run.measure(relative_error(loss, std::log(static_cast<long double>(kClasses))), 4e-16, "loss ln C");
    // At density 0 only the sample's own weight moves: dL/dsigma_k = delta_k (h_k W + b) . (1/C - [label]).
    ray.backward();
    SemanticRay<double> oracle(6);
    for (std::size_t k = 0; k < 6; ++k) {
      long double want = 0;
      for (std::int32_t c = 0; c < kClasses; ++c) {
        auto s = static_cast<long double>(ray.bias()(0, c));
        for (std::int32_t h = 0; h < kHidden; ++h)
          s += static_cast<long double>(ray.rays.hidden[k * kHidden + static_cast<std::size_t>(h)]) *
               static_cast<long double>(ray.weight()(h, c));
        want += s * (1.0L / kClasses - (c == kLabel ? 1 : 0));
      }
      want *= static_cast<long double>(ray.rays.delta[k]);
      run.measure(relative_error(ray.rays.d_sigma[k], want), tolerance_of<Real>(1e-5), "density gradient");
      // The same by differences of the whole way, one-sided and extrapolated twice: densities are not negative.
      double at[4];
      for (int i = 0; i < 4; ++i) {
        oracle.rays.sigma[k] = i == 0 ? 0.0 : 1e-3 * static_cast<double>(1 << (i - 1));
        at[i] = oracle.loss();
      }
      oracle.rays.sigma[k] = 0;
      const double d1 = (at[1] - at[0]) / 1e-3, d2 = (at[2] - at[0]) / 2e-3, d4 = (at[3] - at[0]) / 4e-3;
      const double e1 = 2 * d1 - d2, e2 = 2 * d2 - d4;
      run.measure(std::abs((4 * e1 - e2) / 3 - static_cast<double>(ray.rays.d_sigma[k])), 2e-6, "by differences");
    }
  });
}

void half_opacity(CaseRun& run) {
  in_both_precisions(run, [&]<class Real>(Real) {
    const long double want = std::exp(5.0L) / (std::exp(5.0L) + 27);
    for (const bool by_bias : {false, true}) {
      for (const int samples : {1, 7}) {
        SemanticRay<Real> ray(samples);
        for (auto* values : {&ray.rays.hidden}) std::fill(values->begin(), values->end(), Real(0));
        for (std::int64_t i = 0; i < ray.weight().size(); ++i) ray.weight().data[i] = 0;
        for (std::int64_t i = 0; i < ray.bias().size(); ++i) ray.bias().data[i] = 0;
        for (std::size_t k = 0; k < static_cast<std::size_t>(samples); ++k) {
          ray.rays.hidden[k * kHidden] = Real(1);
          ray.rays.sigma[k] = static_cast<Real>(std::log(2.0L) / (samples * 0.75L));  // opacity 1/2 in all
        }
        (by_bias ? ray.bias() : ray.weight())(0, kLabel) = Real(10);
        const double loss = ray.loss();
        run.measure(std::abs(static_cast<double>(ray.rays.opacity[0]) - 0.5), tolerance_of<Real>(2e-7), "opacity");
        run.measure(std::abs(std::exp(-loss) - static_cast<double>(want)), tolerance_of<Real>(1e-6),
                    by_bias ? "probability, by the bias" : "probability, by the weights");
        run.expect(std::abs(std::exp(-loss) - 0.84608) < 1e-5, "0.8461");
      }
    }
    run.note(fmt::format("p = {:.6f}: a margin of 10 counts 5 at half opacity", static_cast<double>(want)));
  });
}

void detached(CaseRun& run) {
  in_both_precisions(run, [&]<class Real>(Real) {
    testing::RayBuffers<Real> rays({40, 1, 7}, 5);
    rays.space_evenly(4);
    Numbers numbers(42);
    for (Real& v : rays.sigma) v = static_cast<Real>(numbers.in(0, 3));
    for (Real& v : rays.hidden) v = static_cast<Real>(numbers.in(-1, 1));
    for (Real& v : rays.g_hidden) v = static_cast<Real>(numbers.in(-1, 1));
    rays.forward();
    std::fill(rays.d_sigma.begin(), rays.d_sigma.end(), Real(-9));
    CompositeGrad<Real> grad = rays.grad();
    grad.hidden_moves_density = false;
    composite_backward(rays.in(), rays.out(), grad, rays.col(rays.d_sigma), rays.mat(rays.d_rgb, 3),
                       rays.mat(rays.d_hidden, 5));
    for (const Real g : rays.d_sigma) run.measure(std::abs(g), 0, "dL/dsigma when detached");
    for (std::size_t i = 0; i < rays.d_hidden.size(); ++i) {
      const std::size_t sample = i / 5, ray = static_cast<std::size_t>(rays.ray[sample]);
      const long double want =
          static_cast<long double>(rays.weight[sample]) * static_cast<long double>(rays.g_hidden[5 * ray + i % 5]);
      run.measure(relative_error(rays.d_hidden[i], want), tolerance_of<Real>(1e-6), "dL/dh");
    }
    rays.backward();
    run.expect(std::any_of(rays.d_sigma.begin(), rays.d_sigma.end(), [](Real g) { return g != Real(0); }),
               "without the flag semantics do move the density");
  });
  run.row("fp32");
  // The whole pipeline: the density layer's gradient of a step, with and without weight on the semantic loss.
  const auto density_gradient = [&](const char* weight, const char* stop) {
    TrainingBox box(run.registry(), small_config(fmt::format("semantics: {{hidden_width: 16, weight: {}, "
                                                             "stop_gradient_to_density: {}}}\n",
                                                             weight, stop)));
    const StepLosses losses = box.gradients(0);
    run.expect(losses.labelled > 0, "the batch has labels");
    std::vector<float> out;
    for (const Tensor<float>& t : box.pipeline().store().all()) {
      if (t.name.find("/density/") == std::string::npos || !t.learned()) continue;
      out.insert(out.end(), t.grad.data(), t.grad.data() + t.grad.size());
    }
    return out;
  };
  const std::vector<float> without = density_gradient("0", "true"), with = density_gradient("0.7", "true");
  run.expect(!without.empty() && without.size() == with.size(), "the field has a density layer");
  run.measure(std::memcmp(without.data(), with.data(), sizeof(float) * without.size()) == 0 ? 0 : 1, 0, "same bits");
  run.expect(with != density_gradient("0.7", "false"), "without the flag they differ");
}

}  // namespace semfield::numerics
