// Whole steps and runs on the device against those of the CPU: one step's losses and gradients, training,
// checkpoints both ways, rendering, faults.

#include <cstdio>

#include "compute/isa.h"
#include "core/error.h"
#include "core/rng.h"
#include "core/workspace.h"
#include "cuda/kernels/kernels.h"
#include "cuda/launch.h"
#include "cuda/steps/batch_drawer.h"
#include "device_fixture.h"
#include "eval/evaluator.h"
#include "model/param_store.h"
#include "plugins/fields/nerf_mlp/tests/fused_fixture.h"
#include "scene/scene.h"
#include "testkit/compare.h"
#include "tests/session/step_configs.h"
#include "train/checkpoint.h"

namespace semfield {
namespace {

using namespace testing_train;
using testing::device_count;
using testing::expect_near;
using testing::there;

// Both devices take the batch as one tile, so that rays have the same numbers.
struct Training : TestRun {
  Training(Registry& registry, const std::string& yaml, const std::string& runtime)
      : TestRun(yaml + "runtime: {" + runtime + "}\n", registry) {}
  StepLosses train(std::int64_t steps) { return to(steps); }
};

Device runs_on(const Session& session) { return session.pipeline->executor().device().kind; }

void copy_values(const ParamStore<float>& from, ParamStore<float>& to) {
  for (std::size_t i = 0; i < from.all().size(); ++i) {
    const AlignedBuffer<float>& value = from.all()[i].value;
    ASSERT_EQ(value.size(), to.all()[i].value.size()) << from.all()[i].name;
    std::copy_n(value.data(), value.size(), to.all()[i].value.data());
  }
}

View<const float> moments(const Tensor<float>& tensor) { return {tensor.moment1.data(), tensor.size(), 1}; }

// The first moment after the first step is (1 - beta1) times the gradient.
void expect_equal_gradients(const Training& cuda, const Training& cpu, double tolerance, const std::string& what) {
  const auto& a = cuda.session.pipeline->store().all();
  const auto& b = cpu.session.pipeline->store().all();
  ASSERT_EQ(a.size(), b.size());
  for (std::size_t i = 0; i < a.size(); ++i) {
    if (!b[i].learned()) continue;
    EXPECT_EQ(testkit::compare(moments(a[i]), moments(b[i]), tolerance, 1e-12 / tolerance), "")
        << what << ": gradient of " << b[i].name;
  }
}

class CudaStep : public ::testing::TestWithParam<StepCase> {};

TEST_P(CudaStep, LossesAndGradientsAreTheProcessors) {
  SEMFIELD_NEEDS_DEVICE();
  const StepCase& row = GetParam();
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
INSTANTIATE_TEST_SUITE_P(All, CudaStep, ::testing::ValuesIn(kStepCases), name_of_step);

std::string paper_config(const std::string& scene, std::int32_t hidden_width) {
  const std::string encodings =
      "    position: {type: frequency, frequencies: 10}\n"
      "    direction: {type: frequency, frequencies: 4}\n"
      "    field: {type: nerf_mlp}\n";
  return "scene: " + scene + "\nsemantics: {hidden_width: " + std::to_string(hidden_width) + ", weight: 0.3}\n" +
         "passes:\n  - name: coarse\n    sampler: {type: stratified, samples: 8}\n" + encodings +
         "  - name: fine\n    sampler: {type: importance, samples: 13}\n" + encodings + "train: {steps: 9, rays: 64}\n";
}

struct CudaRun : testing::DeviceTest {
  Registry& registry = all_plugins();
};

// The network of the paper in bf16: fused with the head's hidden layer, against the layers one by one in fp32.
// Gradients are compared by norm: a unit within rounding of zero may fall on either side of its ReLU (testkit/laws.h).
TEST_F(CudaRun, TheFusedNetworkTakesTheSemanticLayerWithIt) {
  SEMFIELD_NEEDS_FUSED();
  constexpr double kGradient = 0.25;
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
        EXPECT_EQ(testkit::compare_norms(moments(*twin), moments(of_layers[i]), kGradient), "") << of_layers[i].name;
        EXPECT_GT(testkit::difference(moments(*twin), moments(of_layers[i])).max_want, 0) << of_layers[i].name;
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
TEST_F(CudaRun, FiveHundredStepsReachTheProcessorsQuality) {
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
TEST_F(CudaRun, ATermThatBeginsLaterBeginsInItsStep) {
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

TEST_F(CudaRun, DeterministicRunsHaveTheSameBits) {
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

TEST_F(CudaRun, CheckpointsGoBothWays) {
  const auto exchange = [&](const std::string& first, const std::string& second) {
    const TempDir dir;
    Training a(registry, hash_config(), first);
    a.train(40);
    check_storable(a.session.pipeline->store(), 40);
    write_safetensors(dir / "state.safetensors", a.trainer.tensors(), {});
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

TEST_F(CudaRun, RendersWhatTheProcessorRenders) {
  for (const auto& config :
       {hash_config(), two_pass_config(), branch_config(", dropout: 0.2"), head_config(", learning_rate: 0.3")}) {
    Training cuda(registry, config, "device: cuda");
    cuda.train(100);
    const int frame = cuda.session.scene.frames_of(Split::train).front();
    const FrameInfo& info = cuda.session.scene.info.frames[frame];
    const RayCamera camera{info.camera, info.world_from_camera, false};
    const std::vector<std::int16_t> truth;
    const auto draw = [&](Training& of) {
      FrameOptions options{.probability = true, .classes = of.session.classes()};
      if (!of.session.config.heads.empty()) options.channels = {"albedo"};
      return render_frame(*of.session.pipeline, camera, of.session.limits, of.session.plan.class_of_logit, truth,
                          options);
    };
    Training cpu(registry, config, "device: cpu");
    copy_values(cuda.session.pipeline->store(), cpu.session.pipeline->store());
    cpu.session.pipeline->executor().upload(100);
    const RenderedFrame a = draw(cuda), b = draw(cpu);
    const auto difference = [](const std::vector<float>& got, const std::vector<float>& want) {
      return testkit::difference(testing::host_view(got, 1), testing::host_view(want, 1));
    };
    std::size_t other_label = 0;
    for (std::size_t i = 0; i < a.label.size(); ++i) other_label += a.label[i] != b.label[i] ? 1 : 0;
    EXPECT_LT(difference(a.rgb, b.rgb).max_abs, 2e-2);  // the CPU stops rays early, the device does not
    EXPECT_LT(difference(a.depth_m, b.depth_m).max_abs, 5e-2);
    EXPECT_LE(other_label, a.label.size() / 200);
    ASSERT_EQ(a.channels.size(), cuda.session.config.heads.size());
    for (std::size_t c = 0; c < a.channels.size(); ++c) {
      const std::vector<float>&got = a.channels[c].values, &want = b.channels[c].values;
      ASSERT_EQ(got.size(), want.size());
      const testkit::Difference off = difference(got, want);
      EXPECT_GT(off.max_want, 0.1);
      EXPECT_LT(off.max_abs, 0.02 * off.max_want);
    }
    const auto classes = static_cast<std::size_t>(cuda.session.classes());
    ASSERT_EQ(a.probability.size(), classes * a.label.size());
    for (std::size_t i = 0; i < a.label.size(); ++i) {
      const float* const row = a.probability.data() + i * classes;
      ASSERT_EQ(row[a.label[i]], a.confidence[i]) << "pixel " << i;
      ASSERT_EQ(*std::max_element(row, row + classes), a.confidence[i]) << "pixel " << i;
    }
  }
}

TEST_F(CudaRun, AFaultNamesTensorAndPixelAndChangesNothing) {
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
    EXPECT_HAS(error_of([&] { cuda.trainer.advance(8); }), weight->name, "pixel");
    EXPECT_EQ(cuda.trainer.step(), 40);
    cuda.trainer.collect();
    EXPECT_EQ(before, fingerprint(cuda.session.pipeline->store()));
  }
}

TEST_F(CudaRun, MemoryThatIsNotThereIsAnErrorWithFiguresAndRemedies) {
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

TEST_F(CudaRun, AStepThatDoesNotFitNamesRaysThatDo) {
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

TEST(CudaBuild, WithoutADeviceTheReasonIsSaid) {
  if (testing::has_device()) GTEST_SKIP() << "this machine has a device";
  Registry registry = make_registry();
  EXPECT_HAS(error_of(ErrorKind::unavailable, [&] { open_text(hash_config("runtime: {device: cuda}\n"), registry); }),
             "runtime.device");
  EXPECT_EQ(runs_on(open_text(hash_config("runtime: {device: auto}\n"), registry)), Device::cpu);
}

// Which of several devices an executor runs on.

using testing::DeviceLaunch;
using testing::DeviceMatrix;

// A deterministic run.
struct Subject : TestRun {
  explicit Subject(const std::string& device)
      : TestRun(hash_config("runtime: {device: " + device + ", deterministic: true}\n")) {}
};

using CudaDevices = testing::DeviceTest;

TEST_F(CudaDevices, AnOrdinalThatIsNotThereIsRefusedWithThoseThatAre) {
  const std::string missing = "cuda:" + std::to_string(device_count());
  EXPECT_HAS(error_of(ErrorKind::unavailable, [&] { const Subject run(missing); }),
             "runtime.device: " + missing + ": this machine has ", "cuda:" + std::to_string(device_count() - 1))
      << missing;
}

TEST_F(CudaDevices, TheCallersDeviceIsLeftAsItWas) {
  for (int ordinal = 0; ordinal < std::min(device_count(), 2); ++ordinal) {
    Subject run("cuda:" + std::to_string(ordinal));
    EXPECT_EQ(run.session.pipeline->executor().device(), (DeviceId{Device::cuda, ordinal}));
    run.to(4);
    int current = -1;
    EXPECT_EQ(cudaGetDevice(&current), cudaSuccess);
    EXPECT_EQ(current, 0);
  }
}

// Of equal devices; a run goes on on another one.
TEST_F(CudaDevices, TwoDevicesOfAKindGiveTheSameBitsAndTakeOverFromEachOther) {
  if (device_count() < 2) GTEST_SKIP() << "this machine has one device";
  for (const char* precision : {"", ", precision: bf16"}) {
    const std::string first = std::string("cuda:0") + precision, second = std::string("cuda:1") + precision;
    Subject a(first), b(second);
    a.to(20);
    b.to(20);
    EXPECT_EQ(a.bits(), b.bits()) << precision;
    const TempDir dir;
    write_safetensors(dir / "state.safetensors", a.trainer.tensors(), {});
    Subject c(second);
    c.trainer.load(TensorFile::read(dir / "state.safetensors"), 20);
    a.to(40);
    c.to(40);
    EXPECT_EQ(a.bits(), c.bits()) << precision;
  }
}

// Device memory: what is copied there comes back, arenas and launches.

TEST(CudaMemory, BuffersStartAsZerosAndArenasGiveAlignedDeviceMemory) {
  SEMFIELD_ON_DEVICE(launch);
  const cuda::Buffer<float> buffer(1001, "a test");
  std::vector<float> back(1001, 7);
  cuda::download<float>(buffer.data(), back);
  cuda::synchronize();
  EXPECT_EQ(back, std::vector<float>(1001, 0));
  const Workspace::Scope scope(launch.arena());
  for (const std::int64_t rows : {0, 1, 33}) {
    const View<float> view = launch.arena().take<float>(rows, 3);
    EXPECT_EQ(view.device, Device::cuda);
    EXPECT_EQ(reinterpret_cast<std::uintptr_t>(view.data) % 256, 0u);
  }
}

TEST(CudaMemory, ABufferIsClearedBeforeOtherStreamsUseIt) {
  SEMFIELD_NEEDS_DEVICE();
  constexpr std::size_t kCount = 1001, kBusyBytes = std::size_t{1} << 28;
  const cuda::Buffer<std::byte> busy(kBusyBytes, "a test");
  cudaStream_t stream = nullptr;
  cuda::check(cudaStreamCreateWithFlags(&stream, cudaStreamNonBlocking), "a stream of a test");
  const std::vector<float> values = testing::random_floats(kCount, 1, -1, 1);
  std::vector<float> back(kCount);
  {
    cuda::Launch own{.stream = stream};
    const cuda::LaunchScope scope(own);
    for (int i = 0; i < 400; ++i) {  // the default stream has work for some 20 ms
      cuda::check(cudaMemsetAsync(busy.data(), i, kBusyBytes, nullptr), "work of a test");
    }
    const cuda::Buffer<float> buffer(kCount, "a test");
    cuda::upload<float>(values, buffer.data());
    cuda::check(cudaDeviceSynchronize(), "waiting for both streams");
    cuda::download<float>(buffer.data(), back);
    cuda::synchronize();
  }
  cuda::check(cudaStreamDestroy(stream), "a stream of a test");
  EXPECT_EQ(back, values);
}

// Batches drawn on the device are those that the host fills, bit by bit.

using cuda::BatchDrawer;

constexpr int kAhead = 5;
constexpr RaySourceKind kKinds[] = {RaySourceKind::all_images, RaySourceKind::one_image, RaySourceKind::label_balanced};

// Frames of several sizes, lenses and channels, with an empty one among them.
struct Frames {
  std::vector<FrameBuffer> buffers{5};
  std::vector<StoredFrame> stored;
  std::vector<TrainingLabels::Frame> labels{5};
  std::vector<RayCamera> cameras{5};
  RayLimits limits;

  explicit Frames(bool with_empty = true, bool with_masks = false) {
    const std::int32_t side = with_empty ? 0 : 6;
    const std::int32_t sizes[5][2] = {{17, 9}, {side, side}, {40, 31}, {8, 8}, {33, 5}};
    for (std::size_t f = 0; f < 5; ++f) {
      FrameBuffer& frame = buffers[f];
      frame.width_px = sizes[f][0];
      frame.height_px = sizes[f][1];
      const auto pixels = static_cast<std::size_t>(frame.width_px * frame.height_px);
      const auto random = [f](std::size_t i, std::uint64_t below) {
        return uniform_below({7, f, stream_id("drawer_test")}, i, below);
      };
      frame.rgb.resize(3 * pixels);
      for (std::size_t i = 0; i < frame.rgb.size(); ++i) frame.rgb[i] = static_cast<std::uint8_t>(random(i, 256));
      frame.label.resize(pixels);
      for (std::size_t i = 0; i < pixels; ++i)
        frame.label[i] = random(i, 10) < 7 ? kVoid : static_cast<std::int16_t>(random(i + 5000, 4));
      if (f != 3) {
        frame.depth_m.resize(pixels);
        for (std::size_t i = 0; i < pixels; ++i) frame.depth_m[i] = static_cast<float>(random(i, 6000)) * 0.001F;
      }
      if (with_masks && f != 3) {  // beside frames with masks, one without
        frame.used.resize(pixels);
        for (std::size_t i = 0; i < pixels; ++i) frame.used[i] = random(i + 9000, 3) > 0 ? 1 : 0;
      }
      std::vector<std::uint8_t> alpha(pixels);
      for (std::size_t i = 0; i < pixels; ++i) alpha[i] = static_cast<std::uint8_t>(random(i + 9000, 256));
      if (f != 0) frame.channels = {alpha_channel(frame.width_px, frame.height_px, alpha)};
      RayCamera& camera = cameras[f];
      camera.camera.width_px = frame.width_px;
      camera.camera.height_px = frame.height_px;
      camera.camera.fx = 21.3 + static_cast<double>(f);
      camera.camera.fy = 20.1;
      camera.camera.cx = 0.5 * frame.width_px + 0.37;
      camera.camera.cy = 0.5 * frame.height_px - 0.21;
      if (f == 2) camera.camera.k1 = -0.21, camera.camera.k2 = 0.05, camera.camera.p1 = 0.003;
      if (f == 4) camera.camera.k1 = 0.3;
      if (f == 3 && with_masks) camera.camera.lens = LensKind::fisheye;
      if (f == 0 && with_masks) camera.camera.lens = LensKind::equirectangular;
      camera.undistort = f != 4;
      const double angle = 0.4 * static_cast<double>(f);
      camera.world_from_camera.r = {
          {{std::cos(angle), 0, std::sin(angle)}, {0, 1, 0}, {-std::sin(angle), 0, std::cos(angle)}}};
      camera.world_from_camera.t = {0.1 * static_cast<double>(f), -0.3, 0.2};
      stored.emplace_back(frame);
    }
    limits.near_m = 0.1;
    limits.far_m = 5;
  }
  RaySource make(const RaySourceOptions& options) {
    std::vector<TrainFrame> frames;
    for (std::size_t f = 0; f < 5; ++f) {
      labels[f].hard = stored[f].label;
      frames.push_back({cameras[f], &stored[f], f == 0 ? nullptr : &labels[f], "frame"});
    }
    return RaySource(std::move(frames), {2, 0, kVoid, 1}, limits, options);
  }
};

template <class T>
void expect_bits(const std::vector<T>& got, const std::vector<T>& want, const char* what) {
  ASSERT_EQ(got.size(), want.size()) << what;
  EXPECT_EQ(std::memcmp(got.data(), want.data(), got.size() * sizeof(T)), 0) << what;
}

void expect_same_batches(const RaySource& source, const PixelPool& pool, BatchDrawer& drawer) {
  BatchBuffers want;
  for (const std::int64_t step : {0, 3, 4, 5, 1234567}) {
    SCOPED_TRACE(step);
    source.fill(step, want);
    drawer.draw(step);
    const RayBatch host = want.view(pool.with_labels), seen = drawer.seen(step);
    const BatchLayout layout(host);  // names of the batch are those of the layout
    const RayBatch got = layout.in(drawer.batch(step), Device::cuda);
    expect_bits(there(got.origin), want.origin, "origin");
    expect_bits(there(got.direction), want.direction, "direction");
    expect_bits(there(got.near_far), want.near_far, "near and far");
    expect_bits(there(got.targets.color), want.target, "colour");
    ASSERT_EQ(seen.targets.label.empty(), host.targets.label.empty());
    ASSERT_EQ(seen.label_only.rows, host.label_only.rows);
    for (std::int64_t t = 0; t < host.label_only.rows; ++t)
      EXPECT_EQ(seen.label_only(t, 0), host.label_only(t, 0)) << t;
    if (!host.targets.label.empty()) {
      expect_bits(there(got.targets.label), want.label, "label");
      EXPECT_EQ(std::memcmp(seen.targets.label.data, want.label.data(), want.label.size() * sizeof(std::int16_t)), 0);
    }
    ASSERT_EQ(got.targets.more[channel::camera].empty(), !pool.with_camera);
    if (pool.with_camera) expect_bits(there(got.targets.more[channel::camera]), want.of(channel::camera), "camera");
    for (const auto& [name, is_there] :
         {std::pair{channel::alpha, pool.with_alpha}, {channel::depth, pool.with_depth}}) {
      const View<const float> of_host = seen.targets.more[name];
      SCOPED_TRACE(name);
      ASSERT_EQ(of_host.empty(), !is_there);
      if (!is_there) continue;
      const std::vector<float>& wanted = want.of(name);
      expect_bits(there(got.targets.more[name]), wanted, "on the device");
      EXPECT_EQ(std::memcmp(of_host.data, wanted.data(), wanted.size() * sizeof(float)), 0) << "as the host sees it";
    }
  }
}

void expect_bits_of_the_host(Frames& frames, const RaySourceOptions& options) {
  const RaySource source = frames.make(options);
  const std::optional<PixelPool> pool = source.pool();
  ASSERT_TRUE(pool);
  EXPECT_EQ(pool->used_before.empty(), frames.buffers[0].used.empty()) << "masks";
  BatchDrawer drawer(*pool, kAhead);
  expect_same_batches(source, *pool, drawer);
}

using CudaBatchDrawer = testing::DeviceTest;

TEST_F(CudaBatchDrawer, GivesTheBitsOfMaskedFramesAndWideLenses) {
  DeviceLaunch launch;
  for (const RaySourceKind kind : kKinds) {
    SCOPED_TRACE(static_cast<int>(kind));
    Frames frames(false, true);
    expect_bits_of_the_host(frames, {.train = {.rays = 2500, .ray_source = kind, .labelled_share = 0.3},
                                     .targets = {std::string(channel::depth)},
                                     .tile_rays = 333});
  }
}

TEST_F(CudaBatchDrawer, GivesTheBitsThatTheHostFills) {
  DeviceLaunch launch;
  for (const RaySourceKind kind : kKinds) {
    for (const bool teach : {true, false}) {
      for (const std::int64_t tile : {32, 333, 3000}) {
        SCOPED_TRACE(::testing::Message() << static_cast<int>(kind) << ' ' << teach << ' ' << tile);
        Frames frames(kind != RaySourceKind::one_image);  // which takes every frame
        frames.limits.z_depth = tile == 32;
        frames.limits.clip = tile == 333;
        frames.limits.bounds = {{-1, -1, -1}, {1.5, 1, 2}};
        RaySourceOptions options{
            .train = {.rays = 2500, .ray_source = kind, .labelled_share = 0.3, .label_rays_teach_color = teach}};
        if (tile != 333) options.targets = {std::string(channel::depth)};
        if (tile != 32) options.targets.emplace_back(channel::camera);
        if (tile != 3000) options.targets.emplace_back(channel::alpha);
        options.seed = 11 + static_cast<std::uint64_t>(tile);
        options.tile_rays = tile;
        expect_bits_of_the_host(frames, options);
      }
    }
  }
}

TEST_F(CudaBatchDrawer, TakesNewLabelsOfTheSamePixels) {
  DeviceLaunch launch;
  Frames frames;
  RaySourceOptions options{.train = {.rays = 640, .ray_source = RaySourceKind::label_balanced}};
  RaySource source = frames.make(options);
  BatchDrawer drawer(*source.pool(), kAhead);
  expect_same_batches(source, *source.pool(), drawer);
  const std::uint64_t before = source.version();
  frames.labels[2].hard = LabelMap(std::vector<std::int16_t>(40 * 31, 3));
  frames.labels[4].hard = LabelMap();
  source.relabel();
  EXPECT_NE(source.version(), before);
  ASSERT_TRUE(drawer.relabel(*source.pool()));
  expect_same_batches(source, *source.pool(), drawer);
  Frames others;
  RaySource other = others.make(options);
  EXPECT_FALSE(drawer.relabel(*other.pool()));
}

// The pixels of a run on the device.
struct CudaHeldPixels : testing::DeviceTest {
  void SetUp() override {
    SEMFIELD_NEEDS_DEVICE();
    session.emplace(open_text(hash_config("runtime: {device: cuda}\n")));
    rays = session->make_ray_source();
    pool = rays->pool();
    ASSERT_TRUE(pool);
  }
  Executor<float>& executor() { return session->pipeline->executor(); }
  std::optional<Session> session;
  std::unique_ptr<RaySource> rays;
  std::optional<PixelPool> pool;
};

TEST_F(CudaHeldPixels, WhatAHostMustSayIsLeftToIt) {
  EXPECT_TRUE(executor().hold(*pool));
  PixelPool bad_camera = *pool;
  bad_camera.frames.back().camera.cx = NAN;
  EXPECT_FALSE(executor().hold(bad_camera));
  PixelPool bad_label = *pool;
  bad_label.read_labels = [](std::size_t, std::span<std::int16_t>) {
    throw Error(ErrorKind::data, "test.error.made", "no class", "");
  };
  EXPECT_FALSE(executor().hold(bad_label));
}

TEST_F(CudaHeldPixels, ThatDoNotFitStayOnTheHostWhichIsSaidOnce) {
  std::vector<std::int64_t> offsets(pool->offsets.begin(), pool->offsets.end());
  offsets.back() = std::int64_t{1} << 40;
  pool->offsets = offsets;
  (void)executor().take_notes();
  EXPECT_FALSE(executor().hold(*pool));
  const std::vector<std::string> notes = executor().take_notes();
  ASSERT_EQ(notes.size(), 1u);
  EXPECT_HAS(notes[0], "pixels stay in the host's memory");
  EXPECT_FALSE(executor().hold(*pool));
  EXPECT_TRUE(executor().take_notes().empty());
}

// Adam on the device against the CPU's: the same bits where that one has fused multiply-add.

using AdamTensor = AdamTensor<float>;
using cuda::Stage;
using testing::NotedFault;

constexpr double kRate = 1e-2;  // of every step here

struct Shape {
  std::int64_t rows;
  std::int32_t cols;
  bool touched_only = false;
  bool semantic = false;
  std::int64_t shift = 0;  // elements by which arrays miss an aligned start
};

// A tensor on both sides.
struct Twin {
  Twin(const Shape& shape_in, std::uint64_t seed) : shape(shape_in) {
    const std::int64_t size = shape.rows * shape.cols;
    value = testing::random_floats(size, seed, -1, 1);
    m = testing::random_floats(size, seed + 1, -0.1, 0.1);
    v = testing::random_floats(size, seed + 2, 0, 0.01);
    grad = testing::random_floats(size, seed + 3, -1, 1);
    for (std::int64_t r = 0; r < shape.rows; ++r) {  // most rows of a table without a gradient, some with one element
      for (std::int32_t c = 0; c < shape.cols; ++c) {
        const auto i = static_cast<std::size_t>(r * shape.cols + c);
        if (shape.touched_only && (r % 5 != 1 || (r % 2 == 0 && c != r % shape.cols)))
          grad[i] = c % 2 == 0 ? 0.F : -0.F;
        if (r % 11 == 3) value[i] = -0.F;
      }
    }
    for (auto* there : {&there_value, &there_m, &there_v, &there_grad})
      *there = std::make_unique<DeviceMatrix<float>>(size + shape.shift, 1);
    send();
  }
  void send() {
    const auto shifted = [this](const std::vector<float>& from) {
      std::vector<float> all(static_cast<std::size_t>(shape.shift), 0.F);
      all.insert(all.end(), from.begin(), from.end());
      return all;
    };
    there_value->write(shifted(value));
    there_m->write(shifted(m));
    there_v->write(shifted(v));
    there_grad->write(shifted(grad));
  }
  AdamTensor tensor() const {
    const auto at = [this](const auto& matrix) { return matrix->data() + shape.shift; };
    return {at(there_value), at(there_grad),     at(there_m),    at(there_v), shape.rows,
            shape.cols,      shape.touched_only, shape.semantic, rule().rate, rule().rate * rule().decay};
  }
  // Semantic tensors have a rule of their own.
  LearningRule rule() const { return shape.semantic ? LearningRule{0.3, 0.1, true} : LearningRule{}; }
  std::vector<float> back(const std::unique_ptr<DeviceMatrix<float>>& there) const {
    const std::vector<float> all = there->read();
    return {all.begin() + shape.shift, all.end()};
  }
  View<float> view(std::vector<float>& x) const { return {x.data(), shape.rows, shape.cols}; }
  void update(AdamStep step) {
    step.step_size *= rule().rate;
    step.decay = kRate * (rule().rate * rule().decay);
    if (shape.touched_only) {
      adam_touched<float>(step, view(value), view(grad), view(m), view(v), 0, shape.rows);
    } else {
      adam_dense<float>(step, view(value), view(grad), view(m), view(v), 0, shape.rows);
      grad.assign(grad.size(), 0.F);
    }
  }

  Shape shape;
  std::vector<float> value, m, v, grad;
  std::unique_ptr<DeviceMatrix<float>> there_value, there_m, there_v, there_grad;
};

struct Model {
  explicit Model(const std::vector<Shape>& shapes) {
    for (const Shape& shape : shapes) {
      twins.push_back(std::make_unique<Twin>(shape, 10 * (twins.size() + 1)));
      total += shape.rows * shape.cols;
    }
    std::vector<AdamTensor> list;
    for (const auto& twin : twins) list.push_back(twin->tensor());
    tensors = std::make_unique<DeviceMatrix<AdamTensor>>(list, 1);
  }
  AdamTable<float> table() const { return {tensors->data(), static_cast<int>(twins.size()), total}; }
  void check() const { cuda::check_gradients(table()); }
  void update() const { cuda::adam_update(&cuda::launch().cell->adam, table()); }

  std::vector<std::unique_ptr<Twin>> twins;
  std::unique_ptr<DeviceMatrix<AdamTensor>> tensors;
  std::int64_t total = 0;
};

cuda::StepCell cell_of(const AdamStep& step, std::uint64_t number, bool labelled = true) {
  cuda::StepCell cell;
  cell.step = number;
  cell.adam = step;
  cell.adam.labelled = labelled;
  return cell;
}

// The same bits, or a unit of the last place where the CPU rounds products.
void expect_same(const std::vector<float>& got, const std::vector<float>& want, const char* what) {
  ASSERT_EQ(got.size(), want.size());
  const bool fused = isa() != Isa::generic;
  for (std::size_t i = 0; i < got.size(); ++i) {
    if (fused) {
      ASSERT_EQ(got[i], want[i]) << what << ' ' << i;
    } else {
      ASSERT_NEAR(got[i], want[i], 1.3e-7 * std::abs(want[i])) << what << ' ' << i;
    }
    ASSERT_EQ(std::signbit(got[i]), std::signbit(want[i])) << what << ' ' << i;
  }
}

std::vector<Shape> shapes() {
  std::vector<Shape> all{{1, 1},
                         {0, 3},
                         {63, 256},
                         {1, 257},
                         {7, 3},
                         {1023, 1},
                         {1025, 1},
                         {4097, 3},
                         {256, 29, false, true},
                         {1, 29, false, true},
                         {33, 3, false, false, 1}};
  for (const std::int32_t cols : {1, 2, 3, 4, 5, 8, 1500}) {
    for (const std::int64_t rows : {1, 31, 4097}) all.push_back({cols == 1500 ? rows % 100 : rows, cols, true});
  }
  all.push_back({1003, 2, true, false, 1});
  all.push_back({1 << 19, 2, true});
  return all;
}

TEST(CudaAdam, TheBitsOfTheProcessor) {
  SEMFIELD_ON_DEVICE(launch);
  Model model(shapes());
  AdamParams rule;
  for (std::int64_t number = 0; number < 3; ++number) {
    const AdamStep step = adam_step(rule, kRate, number * 1000);
    launch.set_cell(cell_of(step, static_cast<std::uint64_t>(number)));
    model.check();
    ASSERT_EQ(launch.take_fault(), std::nullopt);
    model.update();
    for (const auto& twin : model.twins) {
      SCOPED_TRACE(std::to_string(twin->shape.rows) + " x " + std::to_string(twin->shape.cols) +
                   (twin->shape.touched_only ? ", touched rows" : ""));
      twin->update(step);
      expect_same(twin->back(twin->there_value), twin->value, "value");
      expect_same(twin->back(twin->there_m), twin->m, "first moment");
      expect_same(twin->back(twin->there_v), twin->v, "second moment");
      const std::vector<float> grad = twin->back(twin->there_grad);
      for (const float g : grad) ASSERT_EQ(g, 0);
      for (const auto* there : {&twin->there_value, &twin->there_m, &twin->there_v, &twin->there_grad})
        EXPECT_EQ((*there)->surroundings(), "");
      twin->grad = testing::random_floats(static_cast<std::int64_t>(grad.size()), 77, -1, 1);
      twin->send();
    }
  }
}

TEST(CudaAdam, WithoutLabelsTheSemanticTensorsStay) {
  SEMFIELD_ON_DEVICE(launch);
  const Model model({{64, 3}, {64, 29, false, true}, {64, 3}});
  launch.set_cell(cell_of(adam_step({}, kRate, 0), 0, false));
  model.update();
  for (const auto& twin : model.twins) {
    EXPECT_EQ(twin->back(twin->there_value) == twin->value, twin->shape.semantic);
    EXPECT_EQ(twin->back(twin->there_m) == twin->m, twin->shape.semantic);
    EXPECT_EQ(twin->back(twin->there_grad) == twin->grad, twin->shape.semantic);
  }
}

TEST(CudaAdam, UnsoundElementsAreFoundInEveryArray) {
  SEMFIELD_ON_DEVICE(launch);
  const Model model({{3, 5}, {0, 7}, {700, 3}, {700, 3, false, false, 1}, {5000, 2, true}, {999, 3, true}, {2, 2}});
  const float inf = std::numeric_limits<float>::infinity(), nan = std::numeric_limits<float>::quiet_NaN();
  for (std::size_t tensor = 0; tensor < model.twins.size(); ++tensor) {
    Twin& twin = *model.twins[tensor];
    const Shape& shape = twin.shape;
    if (shape.rows == 0) continue;
    const std::int64_t windows = shape.touched_only ? kTableWindows : 1;
    for (const std::int64_t row : {std::int64_t{1}, shape.rows / 2 / 10 * 10 + 1, shape.rows - 1}) {
      if (shape.touched_only && row % 5 != 1) continue;  // not touched
      const auto at = static_cast<std::size_t>(row * shape.cols + shape.cols - 1);
      int array = 0;
      for (auto* values : {&twin.grad, &twin.value, &twin.m, &twin.v}) {
        for (const float bad : {nan, inf, -inf, array == 3 ? -1e-30F : -2e19F, array == 3 ? 2e38F : 2e19F}) {
          const float before = std::exchange((*values)[at], bad);
          twin.send();
          int found = 0;
          for (std::int64_t number = 0; number < windows; ++number) {
            launch.set_cell(cell_of(adam_step({}, kRate, 0), static_cast<std::uint64_t>(number)));
            model.check();
            const auto fault = launch.take_fault();
            if (!fault) continue;
            EXPECT_EQ(*fault, (NotedFault{Stage::gradient, static_cast<std::int64_t>(tensor)}));
            ++found;
          }
          EXPECT_EQ(found, array == 0 ? windows : 1)
              << "tensor " << tensor << ", row " << row << ", array " << array << ", value " << bad;
          (*values)[at] = before;
        }
        ++array;
      }
      twin.send();
    }
  }
  // A row that no gradient touches is not looked at (row 13, which shares 16 bytes with it, has none either).
  Twin& table = *model.twins[4];
  table.m[2 * 12] = inf;
  table.send();
  for (std::uint64_t number = 0; number < kTableWindows; ++number) {
    launch.set_cell(cell_of(adam_step({}, kRate, 0), number));
    model.check();
    EXPECT_EQ(launch.take_fault(), std::nullopt);
  }
}

}  // namespace
}  // namespace semfield
