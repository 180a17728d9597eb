// Cases D14 to D17: activations of colour and density, and colour targets out of range.
#include <fmt/format.h>

#include "compute/math_functions.h"
#include "encoder_box.h"
#include "loss_cases.h"
#include "losses/semantic_cross_entropy.h"
#include "model/density_activation.h"
#include "scene/scene.h"
#include "tests/model_compositor/rays_of_slabs.h"
#include "training_box.h"

namespace semfield::numerics {

namespace {

constexpr DensityActivation kActivations[] = {DensityActivation::relu, DensityActivation::softplus,
                                              DensityActivation::trunc_exp};

std::string name_of(DensityActivation kind) {
  return std::string(ChoiceNames<DensityActivation>::names[static_cast<std::size_t>(kind)]);
}

template <class Real>
View<const Real> column(const std::vector<Real>& v) {
  return {v.data(), static_cast<std::int64_t>(v.size()), 1};
}
template <class Real>
View<Real> column(std::vector<Real>& v) {
  return {v.data(), static_cast<std::int64_t>(v.size()), 1};
}

template <class Real>
std::vector<Real> density_of(DensityActivation kind, const std::vector<Real>& raw) {
  std::vector<Real> sigma(raw.size(), Real(-9));
  density_forward<Real>(kind, column(raw), column(sigma));
  return sigma;
}
/// d_raw for d_sigma = 1.
template <class Real>
std::vector<Real> density_slope(DensityActivation kind, const std::vector<Real>& raw) {
  std::vector<Real> slope(raw.size(), Real(-9));
  const std::vector<Real> ones(raw.size(), Real(1));
  density_backward<Real>(kind, column(raw), column(ones), column(slope));
  return slope;
}

long double sigmoid_of(long double x) {
  const long double e = std::exp(-std::abs(x));
  return (x < 0 ? e : 1.0L) / (1 + e);
}
long double density_reference(DensityActivation kind, long double x) {
  if (kind == DensityActivation::relu) return std::max(x, 0.0L);
  if (kind == DensityActivation::softplus) return std::max(x, 0.0L) + std::log1p(std::exp(-std::abs(x)));
  return std::exp(std::min(x, 15.0L));
}
long double slope_reference(DensityActivation kind, long double x) {
  if (kind == DensityActivation::relu) return x > 0 ? 1.0L : 0.0L;
  return kind == DensityActivation::softplus ? sigmoid_of(x) : std::exp(std::min(x, 15.0L));
}

template <class Real>
auto make_field(const Registry& registry, const std::string& name, const FieldBuild& build) {
  const testkit::Settings settings =
      name == "nerf_mlp" ? testkit::Settings{{"depth", "4"}, {"skip_at", "2"}, {"width", "16"}, {"view_width", "16"}}
                         : testkit::Settings{{"hidden_width", "16"}, {"color_width", "16"}};
  const PluginEntry& entry = registry.get(PluginKind::field, name);
  const auto params = testkit::make_params(entry, settings);
  if constexpr (std::is_same_v<Real, float>) {
    return entry.field32(*params, build, registry.kernels());
  } else {
    return entry.field64(*params, build, registry.kernels());
  }
}

/// Colour and its bias gradient of a field whose colour layer has bias `raw` and no weights, for dL/drgb = 1.
template <class Real>
void check_saturated_field(CaseRun& run, const std::string& name, Precision precision, Real raw) {
  FieldBuild build{.position_dims = 6, .direction_dims = 4, .precision = precision};
  const auto field = make_field<Real>(run.registry(), name, build);
  testkit::TensorBox<Real> box(*field, 1);
  int bias = -1;
  for (std::size_t i = 0; i < box.count(); ++i) {
    const std::string& tensor = box.specs()[i].name;
    if (!(tensor.starts_with("rgb/") || tensor.starts_with("color/")) || !box.learned(i)) continue;
    const bool is_bias = tensor.ends_with("bias");
    if (is_bias) bias = static_cast<int>(i);
    for (std::int64_t e = 0; e < box.value(i).size(); ++e) box.value(i).data[e] = is_bias ? raw : Real(0);
  }
  run.expect(bias >= 0, name + " has a colour bias");
  if (bias < 0) return;
  constexpr int kSamples = 5;
  Workspace workspace;
  StepContext ctx{.workspace = &workspace};
  field->derive(ctx, box.tensors());
  std::vector<Real> position(6 * kSamples, Real(0.3)), direction(4, Real(0.5)), sigma(kSamples), rgb(3 * kSamples);
  std::vector<Real> feature(static_cast<std::size_t>(kSamples * field->traits().feature_dims));
  const std::vector<std::int32_t> ray(kSamples, 0);
  const FieldIn<Real> in{{position.data(), kSamples, 6}, {direction.data(), 1, 4}, {ray.data(), kSamples, 1}};
  const FieldOut<Real> out{
      column(sigma), {rgb.data(), kSamples, 3}, {feature.data(), kSamples, field->traits().feature_dims}};
  const View<std::byte> saved =
      workspace.take<std::byte>(1, static_cast<std::int32_t>(field->saved_bytes(kSamples, 1)));
  const Saved memory(saved.data, static_cast<std::size_t>(saved.cols));
  field->forward(ctx, box.tensors(), in, out, memory);
  const std::vector<Real> ones(3 * kSamples, Real(1));
  FieldGrad<Real> grad{.rgb = {ones.data(), kSamples, 3}};
  field->backward(ctx, box.tensors(), in, out, grad, memory, {});
  field->derive_backward(ctx, box.tensors());
  const long double y = sigmoid_of(static_cast<long double>(raw));
  for (const Real c : rgb) {
    run.expect(c >= 0 && c <= 1, "a colour lies in 0..1");
    run.measure(error_above_quantum<Real>(c, y), tolerance_of<Real>(1e-6), "colour");
  }
  for (int c = 0; c < 3; ++c) {
    const Real g = box.grad(static_cast<std::size_t>(bias))(0, c);
    run.expect(std::isfinite(g) && g >= 0, "a saturated gradient is finite and not negative");
    // 1 - y is taken from the rounded y: absolute, not relative.
    run.measure(static_cast<double>(std::abs(static_cast<long double>(g) - kSamples * y * (1 - y))),
                tolerance_of<Real>(1e-6), "colour gradient");
  }
}

}  // namespace

void saturated_sigmoid(CaseRun& run) {
  const auto sweep = [&]<class Real>(Real, Precision precision) {
    for (const char* name : {"tiny_mlp", "nerf_mlp"}) {
      for (const double raw : {0.0, 10.0, -10.0, 17.0, 89.0, -89.0, 100.0, -100.0, 1e4, -1e4})
        check_saturated_field<Real>(run, name, precision, static_cast<Real>(raw));
    }
  };
  in_both_precisions(run, [&]<class Real>(Real) {
    std::vector<Real> x, y;
    for (int i = -1200; i <= 1200; ++i) x.push_back(static_cast<Real>(i) / Real(8));
    y = x;
    sigmoid_inplace<Real>(y.data(), static_cast<std::int64_t>(y.size()));
    for (std::size_t i = 0; i < x.size(); ++i) {
      run.measure(error_above_quantum<Real>(y[i], sigmoid_of(static_cast<long double>(x[i]))), tolerance_of<Real>(1e-6),
                  "sigmoid");
      run.expect(y[i] >= 0 && y[i] <= 1, "a sigmoid lies in 0..1");
    }
    sweep(Real{}, Precision::fp32);
  });
  run.row("bf16");
  sweep(float{}, Precision::bf16);
}

void hdr_target(CaseRun& run) {
  in_both_precisions(run, [&]<class Real>(Real) {
    const float nan = std::numeric_limits<float>::quiet_NaN();
    const std::vector<Real> color{Real(0.25), Real(0.5), Real(1), Real(0), Real(0.125), Real(0.75)};
    std::vector<float> target{1e4f, -1.f, 0.5f, 65504.f, 1e-30f, 1.f};
    std::vector<Real> slope(6);
    const auto loss = [&] {
      return photometric_loss<Real>({color.data(), 2, 3}, {target.data(), 2, 3}, 6.0, 1.0, {slope.data(), 2, 3});
    };
    long double want = 0;
    for (std::size_t i = 0; i < 6; ++i) {
      const long double error = static_cast<long double>(color[i]) - static_cast<long double>(target[i]);
      want += error * error;
    }
    run.measure(relative_error(loss(), want), tolerance_of<Real>(1e-6), "loss, not clamped");
    for (std::size_t i = 0; i < 6; ++i) {
      const long double error = static_cast<long double>(color[i]) - static_cast<long double>(target[i]);
      run.measure(relative_error(slope[i], error / 3), tolerance_of<Real>(1e-6), "gradient");
    }
    target[4] = nan;
    run.expect(std::isnan(loss()), "a NaN target shows in the loss");
    for (std::size_t i = 0; i < 6; ++i) run.expect(std::isnan(slope[i]) == (i == 4), "and in its own gradient alone");
    target[4] = std::numeric_limits<float>::infinity();
    run.expect(!std::isfinite(loss()), "so does an infinite one");
    run.expect(std::is_same_v<decltype(StoredFrame::rgb)::value_type, std::uint8_t>,
               "frames in memory hold 8 bits per channel: training cannot meet such targets");
  });
  run.row("fp32");
  // Were one in a batch all the same, the ray is found and named, and no other.
  for (const float bad : {std::numeric_limits<float>::quiet_NaN(), std::numeric_limits<float>::infinity()}) {
    TrainingBox box(run.registry(), small_config());
    box.gradients(0);
    const RayBatch batch = box.batch().view(box.pipeline().has_semantics());
    run.expect(!box.pipeline().find_fault(0, batch).has_value(), "a sound batch has no fault");
    box.batch().target[3 * 37 + 1] = bad;
    const std::optional<RayFault> fault = box.pipeline().find_fault(0, batch);
    run.expect(fault.has_value() && fault->ray() == 37, "the ray of a bad target is found");
  }
}

void density_activations(CaseRun& run) {
  in_both_precisions(run, [&]<class Real>(Real) {
    std::vector<Real> raw;
    for (const double edge : {0.0, 15.0, 88.0, 89.0, 104.0, 710.0, 1e4, 1e-3, 1e-8, 1e-30}) {
      for (const double sign : {1.0, -1.0}) raw.push_back(static_cast<Real>(sign * edge));
    }
    for (int i = -4000; i <= 4000; ++i) {
      raw.push_back(static_cast<Real>(i) / Real(128));
      raw.push_back(static_cast<Real>(i) * Real(2.5));
    }
    // Below the normal range softplus rounds three times: exponential, quotient and sum, half a quantum each.
    constexpr double kQuanta = 1.51;
    for (const DensityActivation kind : kActivations) {
      const std::vector<Real> sigma = density_of(kind, raw), slope = density_slope(kind, raw);
      for (std::size_t i = 0; i < raw.size(); ++i) {
        const auto x = static_cast<long double>(raw[i]);
        run.measure(error_above_quantum<Real>(sigma[i], density_reference(kind, x), kQuanta), tolerance_of<Real>(1e-6),
                    name_of(kind));
        run.measure(error_above_quantum<Real>(slope[i], slope_reference(kind, x), kQuanta), tolerance_of<Real>(1e-6),
                    name_of(kind) + " slope");
      }
    }
    run.expect(density_of<Real>(DensityActivation::trunc_exp, {Real(1e4)})[0] ==
                   density_of<Real>(DensityActivation::trunc_exp, {Real(15)})[0],
               "trunc_exp stays at e^15 above 15");
    for (const DensityActivation kind : kActivations)
      run.expect(std::isnan(density_of<Real>(kind, {std::numeric_limits<Real>::quiet_NaN()})[0]),
                 name_of(kind) + " keeps NaN, so that it is found");
  });
}

void large_exponents(CaseRun& run) {
  in_both_precisions(run, [&]<class Real>(Real) {
    for (const DensityActivation kind : kActivations) {
      for (const double value : {88.0, 89.0, 710.0, 1e4, 1e30}) {
        const auto raw = static_cast<Real>(value);
        // Forward and backward through activation and compositing: a thin sample, the opaque one, one behind it.
        testing::RayBuffers<Real> rays({3}, 1);
        rays.space_evenly(3);
        const std::vector<Real> raws{Real(-1), raw, Real(2)};
        rays.sigma = density_of(kind, raws);
        for (std::size_t i = 0; i < 9; ++i) rays.rgb[i] = static_cast<Real>(i) / Real(8);
        rays.hidden = {Real(1), Real(-2), Real(3)};
        rays.g_color = {Real(1), Real(-1), Real(0.5)};
        rays.g_hidden = {Real(1)};
        rays.g_depth = {Real(1)};
        rays.g_opacity = {Real(-1)};
        rays.forward();
        rays.backward();
        std::vector<Real> d_raw(3);
        density_backward<Real>(kind, column(std::as_const(raws)), column(std::as_const(rays.d_sigma)), column(d_raw));
        for (std::size_t i = 0; i < 3; ++i) {
          run.expect(std::isfinite(rays.sigma[i]) && std::isfinite(rays.weight[i]), "forward is finite");
          run.expect(std::isfinite(rays.d_sigma[i]) && std::isfinite(d_raw[i]), "backward is finite");
        }
        run.measure(std::abs(static_cast<double>(rays.opacity[0]) - 1), tolerance_of<Real>(1.2e-7), "opacity");
        // What is seen behind: the exponent's rounding, u tau, is the weight's relative error.
        const auto before = static_cast<long double>(rays.sigma[0]) * static_cast<long double>(rays.delta[0]) +
                            static_cast<long double>(rays.sigma[1]) * static_cast<long double>(rays.delta[1]);
        const long double behind = std::exp(-before) * -std::expm1(-static_cast<long double>(rays.sigma[2]) *
                                                                   static_cast<long double>(rays.delta[2]));
        run.measure(error_above_quantum<Real>(rays.weight[2], behind), tolerance_of<Real>(2e-5), "weight behind");
        const long double want = density_reference(kind, static_cast<long double>(raw));
        run.measure(relative_error(rays.sigma[1], want), tolerance_of<Real>(1e-6), "density");
      }
    }
  });
}

}  // namespace semfield::numerics
