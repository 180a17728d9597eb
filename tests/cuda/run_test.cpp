// Whole steps and runs on the device against those of the CPU: one step's losses and gradients, training,
// checkpoints both ways, rendering, faults.
#include <cstdio>

#include "core/error.h"
#include "eval/evaluator.h"
#include "plugins/fields/nerf_mlp/tests/fused_fixture.h"
#include "session/trainer.h"
#include "tests/cuda/device_fixture.h"
#include "tests/cuda/step_configs.h"
#include "tests/session/train_testing.h"

namespace semfield {
namespace {

using namespace testing_train;

// A session with its trainer; both devices take the batch as one tile, so that rays have the same numbers.
struct Training {
  Training(Registry& registry, std::string yaml, const std::string& runtime)
      : session(open_text(yaml + "runtime: {" + runtime + "}\n", registry)),
        rays(session.make_ray_source()),
        trainer(*session.pipeline, *rays, session.config.adam, session.config.schedule, session.config.train.steps) {}
  StepLosses train(std::int64_t steps) {
    StepLosses last;
    while (trainer.step() < steps) last = trainer.advance_many(steps - trainer.step()).back();
    trainer.collect();
    return last;
  }
  Session session;
  std::unique_ptr<RaySource> rays;
  Trainer trainer;
};

Device runs_on(const Session& session) { return session.pipeline->executor().device().kind; }

void copy_values(const ParamStore<float>& from, ParamStore<float>& to) {
  for (std::size_t i = 0; i < from.all().size(); ++i) {
    const AlignedBuffer<float>& value = from.all()[i].value;
    ASSERT_EQ(value.size(), to.all()[i].value.size()) << from.all()[i].name;
    std::copy_n(value.data(), value.size(), to.all()[i].value.data());
  }
}

void expect_near(double cuda, double cpu, double relative, const std::string& what) {
  EXPECT_NEAR(cuda, cpu, relative * std::max(1e-6, std::abs(cpu))) << what;
}

// The first moment after the first step is (1 - beta1) times the gradient.
void expect_equal_gradients(const Training& cuda, const Training& cpu, double tolerance, const std::string& what) {
  const auto& a = cuda.session.pipeline->store().all();
  const auto& b = cpu.session.pipeline->store().all();
  ASSERT_EQ(a.size(), b.size());
  for (std::size_t i = 0; i < a.size(); ++i) {
    if (!b[i].learned()) continue;
    double largest = 0, off = 0;
    for (std::int64_t e = 0; e < b[i].size(); ++e) {
      largest = std::max<double>(largest, std::abs(b[i].moment1.data()[e]));
      off = std::max(
          off, std::abs(static_cast<double>(a[i].moment1.data()[e]) - static_cast<double>(b[i].moment1.data()[e])));
    }
    EXPECT_LE(off, tolerance * largest + 1e-12) << what << ": gradient of " << b[i].name << ", largest " << largest;
  }
}

struct StepCaseRow {
  const char* name;
  std::string (*config)(const std::string&);
  const char* more;
};
const StepCaseRow kSteps[] = {
    {"two_pass", two_pass_config, ""},
    {"hash", hash_config, ""},
    {"closed", two_pass_config, "rendering: {far: closed, background: [0.2, 0.5, 0.9]}\n"},
    {"background", two_pass_config, "rendering: {far: background, density_activation: softplus}\n"},
    {"trunc_exp", two_pass_config, "rendering: {density_activation: trunc_exp, density_bias: -1}\n"},
    {"noise", two_pass_config, "rendering: {density_noise: 1}\n"},
    {"few_labels", few_labels_config, ""},
    {"label_rays_apart", label_rays_config,
     "ray_source: label_balanced, labelled_share: 0.3, label_rays_teach_color: false, "},
    {"branch", branch_config, ""},
    {"branch_of_position", branch_config, ", reads_feature: false, least_weight: 0.03"},
    {"branch_with_dropout", branch_config, ", dropout: 0.3, weight_decay: 0.1, learning_rate: 0.2"},
    {"terms", two_pass_config, kTerms},
    {"terms_hash", hash_config, kTerms},
    {"terms_and_branch", branch_and_terms_config, kTerms},
    {"head", head_config, ""},
    {"head_with_dropout", head_config, ", dropout: 0.3, weight_decay: 0.1, learning_rate: 0.2"},
    {"head_of_the_feature", two_pass_head_config, ""},
    {"head_on_principal_axes", two_pass_head_config, ", width: 2"},
    {"head_beside_a_branch", branch_and_head_config, ", reads_feature: true"},
    {"cameras", cameras_config, ""},
    {"cameras_contracted", contracted_cameras_config, ""},
    {"cameras_two_pass", two_pass_cameras_config, kTerms},
    {"line_of_sight", two_pass_config, "losses: [{type: depth, kind: line_of_sight, weight: 0.3}]\n"},
};

class CudaStep : public ::testing::TestWithParam<StepCaseRow> {};

TEST_P(CudaStep, LossesAndGradientsAreTheProcessors) {
  SEMFIELD_NEEDS_DEVICE();
  const StepCaseRow& row = GetParam();
  Registry registry = make_registry();
  const std::string yaml = row.config(row.more);
  for (const char* savings :
       {"", ", deferred_class_layer: false, fold_feature_layer: false, direction_once_per_ray: false"}) {
    const std::string tile = std::string("tile_rays: 192") + savings;
    Training cuda(registry, yaml, "device: cuda, " + tile), cpu(registry, yaml, "device: cpu, " + tile);
    ASSERT_EQ(runs_on(cuda.session), Device::cuda);
    ASSERT_EQ(runs_on(cpu.session), Device::cpu);
    const StepLosses a = cuda.train(1), b = cpu.train(1);
    const std::string what = std::string(row.name) + savings;
    EXPECT_EQ(a.samples, b.samples) << what;
    EXPECT_EQ(a.labelled, b.labelled) << what;
    EXPECT_EQ(a.dense_passes, b.dense_passes) << what;
    expect_near(a.color, b.color, 1e-4, what + " colour");
    expect_near(a.semantic, b.semantic, 1e-4, what + " semantic");
    expect_near(a.total, b.total, 1e-4, what + " total");
    for (std::size_t i = 0; i < kMostLossTerms; ++i)
      expect_near(a.terms[i], b.terms[i], 1e-4, what + " term " + std::to_string(i));
    expect_equal_gradients(cuda, cpu, 2e-3, what);
  }
}
INSTANTIATE_TEST_SUITE_P(All, CudaStep, ::testing::ValuesIn(kSteps),
                         [](const ::testing::TestParamInfo<StepCaseRow>& row) { return row.param.name; });

std::string paper_config(const std::string& scene, std::int32_t hidden_width) {
  const std::string encodings =
      "    position: {type: frequency, frequencies: 10}\n"
      "    direction: {type: frequency, frequencies: 4}\n"
      "    field: {type: nerf_mlp}\n";
  return "scene: " + scene + "\nsemantics: {hidden_width: " + std::to_string(hidden_width) + ", weight: 0.3}\n" +
         "passes:\n  - name: coarse\n    sampler: {type: stratified, samples: 8}\n" + encodings +
         "  - name: fine\n    sampler: {type: importance, samples: 13}\n" + encodings + "train: {steps: 9, rays: 64}\n";
}

// The network of the paper in bf16: fused with the head's hidden layer, against the layers one by one in fp32.
// Gradients are compared by norm: a unit within rounding of zero may fall on either side of its ReLU (testkit/laws.h).
TEST(CudaRun, TheFusedNetworkTakesTheSemanticLayerWithIt) {
  SEMFIELD_NEEDS_FUSED();
  constexpr double kGradient = 0.25;
  Registry registry = make_registry();
  for (const char* scene : {"{type: analytic_room}", "{type: analytic_room, labels: {frames: 50%}}"}) {
    for (const std::int32_t hidden_width : {128, 64}) {  // 64: the kernels have no such layer
      SCOPED_TRACE(std::string(scene) + ", hidden " + std::to_string(hidden_width));
      const std::string yaml = paper_config(scene, hidden_width), runtime = "device: cuda, precision: bf16";
      Training fused(registry, yaml, runtime);
      const StepLosses a = fused.train(1);
      Training layers(registry, yaml, "device: cuda, precision: fp32");
      const StepLosses b = layers.train(1);
      expect_near(a.color, b.color, 0.01, "colour");
      expect_near(a.semantic, b.semantic, 0.01, "semantic");
      const auto &of_fused = fused.session.pipeline->store().all(), &of_layers = layers.session.pipeline->store().all();
      for (std::size_t i = 0; i < of_layers.size(); ++i) {
        if (!of_layers[i].learned()) continue;
        const auto twin = std::find_if(of_fused.begin(), of_fused.end(),
                                       [&](const auto& tensor) { return tensor.name == of_layers[i].name; });
        ASSERT_NE(twin, of_fused.end()) << of_layers[i].name;
        double off = 0, norm = 0;
        for (std::int64_t e = 0; e < of_layers[i].size(); ++e) {
          const double want = of_layers[i].moment1.data()[e], got = twin->moment1.data()[e];
          off += (got - want) * (got - want);
          norm += want * want;
        }
        EXPECT_GT(norm, 0) << of_layers[i].name;
        EXPECT_LE(std::sqrt(off), kGradient * std::sqrt(norm)) << of_layers[i].name;
      }
    }
  }
}

struct Quality {
  double psnr = 0, accuracy = 0;
};
Quality quality(Session& session) {
  const SplitScore score = evaluate(*session.pipeline, session.eval_job(session.scene.frames_of(Split::train)),
                                    session.limits, session.plan.class_of_logit);
  return {score.color.psnr_db().value_or(0), score.confusion.total_accuracy().value_or(0)};
}

// Different roundings part ways after some hundred steps; what is learned must not.
TEST(CudaRun, FiveHundredStepsReachTheProcessorsQuality) {
  SEMFIELD_NEEDS_DEVICE();
  Registry registry = make_registry();
  Training cpu(registry, hash_config(), "device: cpu");
  cpu.train(500);
  const Quality expected = quality(cpu.session);
  for (const char* runtime : {"device: cuda", "device: cuda, precision: bf16", "device: cuda, deterministic: true"}) {
    Training cuda(registry, hash_config(), runtime);
    cuda.train(500);
    const Quality found = quality(cuda.session);
    EXPECT_NEAR(found.psnr, expected.psnr, 1.0) << runtime;
    EXPECT_NEAR(found.accuracy, expected.accuracy, 0.03) << runtime;
    std::printf("%s: PSNR %.2f (cpu %.2f), accuracy %.4f (cpu %.4f)\n", runtime, found.psnr, expected.psnr,
                found.accuracy, expected.accuracy);
  }
}

// A step's graph is captured for the terms that work in it.
TEST(CudaRun, ATermThatBeginsLaterBeginsInItsStep) {
  SEMFIELD_NEEDS_DEVICE();
  Registry registry = make_registry();
  const auto steps = static_cast<double>(open_text(hash_config(), registry).config.train.steps);
  const std::string yaml =
      hash_config("losses: [{type: distortion, weight: 0.2, from_step: " + std::to_string(5.9 / steps) +
                  "}, {type: depth, weight: 0.1}]\n");
  Training cuda(registry, yaml, "device: cuda, tile_rays: 192"), cpu(registry, yaml, "device: cpu, tile_rays: 192");
  for (std::int64_t step = 1; step <= 12; ++step) {
    const StepLosses a = cuda.train(step), b = cpu.train(step);
    EXPECT_EQ(a.active, step > 6 ? 3u : 2u) << step;
    EXPECT_EQ(a.active, b.active) << step;
    EXPECT_EQ(a.terms[0] > 0, step > 6) << step;
    for (const std::size_t i : {0U, 1U}) expect_near(a.terms[i], b.terms[i], 0.01, "term " + std::to_string(i));
  }
}

TEST(CudaRun, DeterministicRunsHaveTheSameBits) {
  SEMFIELD_NEEDS_DEVICE();
  Registry registry = make_registry();
  for (const auto& config : {hash_config(), two_pass_config(), branch_config(", dropout: 0.2"),
                             branch_and_head_config(", dropout: 0.2"), cameras_config(kTerms)}) {
    for (const char* precision : {"fp32", "bf16"}) {
      const std::string runtime = std::string("device: cuda, deterministic: true, precision: ") + precision;
      Training one(registry, config, runtime), two(registry, config, runtime);
      one.train(60);
      two.train(23);  // the grouping of steps changes nothing either
      two.train(60);
      EXPECT_EQ(fingerprint(one.session.pipeline->store()), fingerprint(two.session.pipeline->store())) << runtime;
    }
  }
}

TEST(CudaRun, CheckpointsGoBothWays) {
  SEMFIELD_NEEDS_DEVICE();
  Registry registry = make_registry();
  const auto exchange = [&](const std::string& first, const std::string& second) {
    const TempDir dir;
    Training a(registry, hash_config(), first);
    a.train(40);
    a.trainer.check_storable();
    write_safetensors(dir / "state.safetensors", a.trainer.state(), {});
    Training b(registry, hash_config(), second);
    b.trainer.load(TensorFile::read(dir / "state.safetensors"), 40);
    EXPECT_EQ(fingerprint(a.session.pipeline->store()), fingerprint(b.session.pipeline->store()));
    const StepLosses next_a = a.train(41), next_b = b.train(41);
    expect_near(next_b.total, next_a.total, 1e-3, first + " to " + second);
    b.train(120);
    EXPECT_GT(quality(b.session).psnr, 14) << first << " to " << second;
  };
  exchange("device: cuda, tile_rays: 192", "device: cpu, tile_rays: 192");
  exchange("device: cpu, tile_rays: 192", "device: cuda, tile_rays: 192");
}

TEST(CudaRun, RendersWhatTheProcessorRenders) {
  SEMFIELD_NEEDS_DEVICE();
  Registry registry = make_registry();
  for (const auto& config : {hash_config(), two_pass_config(), branch_config(", dropout: 0.2")}) {
    Training cuda(registry, config, "device: cuda");
    cuda.train(100);
    const int frame = cuda.session.scene.frames_of(Split::train).front();
    const FrameInfo& info = cuda.session.scene.info.frames[frame];
    const RayCamera camera{info.camera, info.world_from_camera, false};
    const std::vector<std::int16_t> truth;
    const auto draw = [&](Training& of) {
      FrameOptions options{.probability = true, .classes = of.session.classes()};
      return render_frame(*of.session.pipeline, camera, of.session.limits, of.session.plan.class_of_logit, truth,
                          options);
    };
    Training cpu(registry, config, "device: cpu");
    copy_values(cuda.session.pipeline->store(), cpu.session.pipeline->store());
    cpu.session.pipeline->executor().upload(100);
    const RenderedFrame a = draw(cuda), b = draw(cpu);
    double worst = 0, worst_depth = 0;
    std::size_t other_label = 0;
    for (std::size_t i = 0; i < a.rgb.size(); ++i) worst = std::max(worst, std::abs(double{a.rgb[i]} - b.rgb[i]));
    for (std::size_t i = 0; i < a.depth_m.size(); ++i) {
      worst_depth = std::max(worst_depth, std::abs(double{a.depth_m[i]} - b.depth_m[i]));
      other_label += a.label[i] != b.label[i] ? 1 : 0;
    }
    EXPECT_LT(worst, 2e-2);  // the CPU stops rays early, the device does not
    EXPECT_LT(worst_depth, 5e-2);
    EXPECT_LE(other_label, a.label.size() / 200);
    const auto classes = static_cast<std::size_t>(cuda.session.classes());
    ASSERT_EQ(a.probability.size(), classes * a.label.size());
    for (std::size_t i = 0; i < a.label.size(); ++i) {
      const float* const row = a.probability.data() + i * classes;
      ASSERT_EQ(row[a.label[i]], a.confidence[i]) << "pixel " << i;
      ASSERT_EQ(*std::max_element(row, row + classes), a.confidence[i]) << "pixel " << i;
    }
  }
}

// The channel is the room's colour: what the head renders points where the colours do, on the device as on a CPU.
TEST(CudaRun, AHeadLearnsItsChannelAndRendersItAsOnTheProcessor) {
  SEMFIELD_NEEDS_DEVICE();
  Registry registry = make_registry();
  for (const char* precision : {"fp32", "bf16"}) {
    for (const std::string& config : {head_config(", learning_rate: 0.3"), two_pass_head_config(", width: 2")}) {
      SCOPED_TRACE(precision + ("\n" + config));
      const std::string of_precision = std::string(", precision: ") + precision;
      Training cuda(registry, config, "device: cuda" + of_precision);
      ASSERT_EQ(runs_on(cuda.session), Device::cuda);
      const double first = cuda.train(1).terms[0], last = cuda.train(300).terms[0];
      EXPECT_LT(last, 0.6 * first);
      Training cpu(registry, config, "device: cpu" + of_precision);
      copy_values(cuda.session.pipeline->store(), cpu.session.pipeline->store());
      cpu.session.pipeline->executor().upload(300);
      const int test = cuda.session.scene.frames_of(Split::test).front();
      const FrameInfo& info = cuda.session.scene.info.frames[static_cast<std::size_t>(test)];
      const auto draw = [&](Training& of) {
        FrameOptions options;
        options.channels = {"albedo"};
        return render_frame(*of.session.pipeline, {info.camera, info.world_from_camera, false}, of.session.limits,
                            of.session.plan.class_of_logit, {}, options);
      };
      const RenderedFrame a = draw(cuda), b = draw(cpu);
      ASSERT_EQ(a.channels.size(), 1U);
      ASSERT_EQ(a.channels[0].cols, b.channels[0].cols);
      ASSERT_EQ(a.channels[0].values.size(), b.channels[0].values.size());
      double worst = 0, largest = 0;
      for (std::size_t i = 0; i < a.channels[0].values.size(); ++i) {
        worst = std::max(worst, std::abs(double{a.channels[0].values[i]} - b.channels[0].values[i]));
        largest = std::max(largest, std::abs(double{b.channels[0].values[i]}));
      }
      EXPECT_GT(largest, 0.1);
      EXPECT_LT(worst, (precision[0] == 'b' ? 0.05 : 0.02) * largest);
    }
  }
}

TEST(CudaRun, AFaultNamesTensorAndPixelAndChangesNothing) {
  SEMFIELD_NEEDS_DEVICE();
  Registry registry = make_registry();
  for (const auto& config : {hash_config(), two_pass_config()}) {
    Training cuda(registry, config, "device: cuda");
    cuda.train(40);
    Tensor<float>* weight = nullptr;
    for (Tensor<float>& t : cuda.session.pipeline->store().all()) {
      if (t.spec.role == TensorRole::dense && t.name.find("color") != std::string::npos) weight = &t;
    }
    ASSERT_NE(weight, nullptr);
    weight->value.data()[0] = std::numeric_limits<float>::quiet_NaN();
    cuda.session.pipeline->executor().upload(40);
    const std::uint32_t before = fingerprint(cuda.session.pipeline->store());
    EXPECT_HAS(error_of([&] { cuda.trainer.advance_many(8); }), weight->name, "pixel");
    EXPECT_EQ(cuda.trainer.step(), 40);
    cuda.trainer.collect();
    EXPECT_EQ(before, fingerprint(cuda.session.pipeline->store()));
  }
}

TEST(CudaRun, MemoryThatIsNotThereIsAnErrorWithFiguresAndRemedies) {
  SEMFIELD_NEEDS_DEVICE();
  try {
    cuda::release(cuda::allocate(std::size_t{1} << 50, "a test"));
    FAIL() << "a petabyte was given";
  } catch (const Error& error) {
    EXPECT_HAS(error.message(), "'a test': requested");
    EXPECT_HAS(error.remedy(), "train.rays");
  }
  EXPECT_EQ(cudaGetLastError(), cudaSuccess);
}

// All but some of the device's memory, held.
struct Crowd {
  explicit Crowd(std::size_t left) {
    const std::size_t unused = cuda::free_bytes();
    if (unused > left) memory = cuda::allocate(unused - left, "a test");
  }
  ~Crowd() { cuda::release(memory); }
  std::byte* memory = nullptr;
};

TEST(CudaRun, AStepThatDoesNotFitNamesRaysThatDo) {
  SEMFIELD_NEEDS_DEVICE();
  Registry registry = make_registry();
  const auto config = [](std::int64_t rays) {
    std::string yaml = paper_config("{type: analytic_room}", 128);
    const std::string few = "rays: 64";
    return yaml.replace(yaml.find(few), few.size(), "rays: " + std::to_string(rays));
  };
  constexpr std::int64_t kRays = 16384;
  Training trained(registry, config(64), "device: cuda");
  trained.train(4);  // what every process takes once
  const Crowd crowd(std::size_t{1} << 30);
  std::int64_t fit = 0;
  {
    Training large(registry, config(kRays), "device: cuda");
    const std::uint32_t before = fingerprint(large.session.pipeline->store());
    try {
      large.train(1);
      FAIL() << "a step of " << kRays << " rays fits into a gigabyte";
    } catch (const Error& error) {
      const std::string remedy = error.remedy(), key = "train.rays: ";
      ASSERT_NE(remedy.find(key), std::string::npos) << error.what();
      fit = std::stoll(remedy.substr(remedy.find(key) + key.size()));
      EXPECT_HAS(error.message(), "requested");
      EXPECT_HAS(remedy, "runtime.device: cpu");
    }
    large.trainer.collect();
    EXPECT_EQ(before, fingerprint(large.session.pipeline->store()));
  }
  EXPECT_GT(fit, kRays / 64);
  EXPECT_LT(fit, kRays);
  Training fitting(registry, config(fit), "device: cuda");
  EXPECT_TRUE(std::isfinite(fitting.train(6).total));
}

// A field of the CPU alone: it reads what it is given where it runs.
struct PlainParams {};
void describe(ParamVisitor&, PlainParams&) {}
void validate(const PlainParams&, Diagnostics&) {}

template <class Real>
class PlainField final : public Field<Real> {
 public:
  PlainField(const PlainParams&, const FieldBuild&, const KernelTables&) {}
  FieldTraits traits() const noexcept override { return {1, false}; }
  std::size_t saved_bytes(std::int64_t, std::int64_t) const noexcept override { return 0; }

 protected:
  void do_forward(const StepContext&, const Tensors<Real>&, const FieldIn<Real>& in, const FieldOut<Real>& out,
                  Saved) const override {
    for (std::int64_t m = 0; m < in.position.rows; ++m) out.sigma(m, 0) = in.position(m, 0);
  }
  void do_backward(const StepContext&, const Tensors<Real>&, const FieldIn<Real>&, const FieldOut<Real>&,
                   const FieldGrad<Real>&, Saved, View<Real>) const override {}
};

TEST(CudaRun, APartWithoutKernelsStaysOnTheProcessorOrIsRefusedByName) {
  SEMFIELD_NEEDS_DEVICE();
  Registry registry = make_registry();
  registry.add_field<PlainField, PlainParams>("plain", "a field of the CPU alone");
  const std::string yaml =
      "scene: {type: analytic_room, frames: 4}\n"
      "passes:\n  - {name: main, sampler: {type: stratified, samples: 8}, position: {type: identity},\n"
      "     direction: {type: identity}, field: {type: plain}}\n";
  EXPECT_EQ(runs_on(open_text(yaml + "runtime: {device: auto}\n", registry)), Device::cpu);
  EXPECT_HAS(error_of(ErrorKind::unavailable, [&] { open_text(yaml + "runtime: {device: cuda}\n", registry); }),
             "field 'plain' has no cuda kernels");
}

TEST(CudaBuild, WithoutADeviceTheReasonIsSaid) {
  if (testing::has_device()) GTEST_SKIP() << "this machine has a device";
  Registry registry = make_registry();
  EXPECT_HAS(error_of(ErrorKind::unavailable, [&] { open_text(hash_config("runtime: {device: cuda}\n"), registry); }),
             "runtime.device");
  EXPECT_EQ(runs_on(open_text(hash_config("runtime: {device: auto}\n"), registry)), Device::cpu);
}

}  // namespace
}  // namespace semfield
