// What an executor on a device promises beside steps: the gradient hook, and which of several devices it runs on.
#include "core/error.h"
#include "core/workspace.h"
#include "cuda/memory.h"
#include "device_fixture.h"
#include "session/trainer.h"
#include "tests/cuda/device_fixture.h"
#include "tests/session/train_testing.h"

namespace semfield {
namespace {

using testing::DeviceLaunch;
using testing::DeviceMatrix;

using namespace testing_train;

constexpr const char* kDeterministic = ", deterministic: true}\n";

// A session with its trainer.
struct Subject {
  Subject(const std::string& yaml, const std::string& device, Registry& registry)
      : session(open_text(yaml + "runtime: {device: " + device + kDeterministic, registry)) {}
  void to(std::int64_t step) {
    while (trainer.step() < step) trainer.advance_many(step - trainer.step());
    trainer.collect();
  }
  void call(GradientHook<float> hook) { session.pipeline->executor().set_gradient_hook(std::move(hook)); }
  std::uint32_t bits() { return fingerprint(session.pipeline->store()); }

  Session session;
  std::unique_ptr<RaySource> rays = session.make_ray_source();
  Trainer trainer{*session.pipeline, *rays, session.config.adam, session.config.schedule};
};

int devices() {
  int count = 0;
  return cudaGetDeviceCount(&count) == cudaSuccess ? count : 0;
}

std::string config(const std::string& weight) {
  std::string yaml = two_pass_config();
  return yaml.replace(yaml.find("weight: 0.3"), 11, "weight: " + weight);
}

// On the hook's stream, by way of the host: the stream is waited for.
void halve(const StepGradients<float>& gradients) {
  const auto stream = static_cast<cudaStream_t>(gradients.stream);
  for (const View<float>& gradient : gradients.tensors) {
    std::vector<float> host(static_cast<std::size_t>(gradient.size()));
    const std::size_t bytes = host.size() * sizeof(float);
    cuda::check(cudaMemcpyAsync(host.data(), gradient.data, bytes, cudaMemcpyDeviceToHost, stream), "a test");
    cuda::check(cudaStreamSynchronize(stream), "a test");
    for (float& g : host) g *= 0.5F;
    cuda::check(cudaMemcpyAsync(gradient.data, host.data(), bytes, cudaMemcpyHostToDevice, stream), "a test");
    cuda::check(cudaStreamSynchronize(stream), "a test");
  }
}

// Twelve steps: graphs are captured in the third, one without a hook and two with it.
TEST(CudaGradientHook, SeesEveryLearnedTensorOfEveryStepAndKeepsTheBits) {
  SEMFIELD_NEEDS_DEVICE();
  Registry registry = make_registry();
  for (const std::string& yaml : {hash_config(), two_pass_config()}) {
    Subject plain(yaml, "cuda", registry), hooked(yaml, "cuda", registry);
    std::vector<std::int64_t> steps;
    hooked.call([&](const StepGradients<float>& gradients) {
      steps.push_back(gradients.step);
      EXPECT_NE(gradients.stream, nullptr);
      std::size_t next = 0;
      for (const Tensor<float>& t : hooked.session.pipeline->store().all()) {
        if (!t.learned()) continue;
        ASSERT_LT(next, gradients.tensors.size());
        const View<float>& view = gradients.tensors[next++];
        EXPECT_EQ(view.rows, t.spec.rows) << t.name;
        EXPECT_EQ(view.cols, t.spec.cols) << t.name;
        EXPECT_EQ(view.device, Device::cuda);
        cudaPointerAttributes where{};
        EXPECT_EQ(cudaPointerGetAttributes(&where, view.data), cudaSuccess);
        EXPECT_EQ(where.type, cudaMemoryTypeDevice) << t.name;
      }
      EXPECT_EQ(next, gradients.tensors.size());
    });
    plain.to(12);
    hooked.to(12);
    EXPECT_EQ(plain.bits(), hooked.bits());
    EXPECT_EQ(steps.size(), 12u);
    hooked.call(nullptr);
    plain.to(18);
    hooked.to(18);
    EXPECT_EQ(plain.bits(), hooked.bits());
    EXPECT_EQ(steps.size(), 12u);
  }
}

// The first moment after the first step is (1 - beta1) times the gradient.
TEST(CudaGradientHook, HalfOfTheGradientsIsHalfOfTheWeight) {
  SEMFIELD_NEEDS_DEVICE();
  Registry registry = make_registry();
  Subject full(config("0.25"), "cuda", registry), halved(config("0.25"), "cuda", registry);
  Subject light(config("0.125"), "cuda", registry);
  halved.call(halve);
  for (Subject* run : {&full, &halved, &light}) run->to(1);
  int semantic = 0;
  for (std::size_t i = 0; i < full.session.pipeline->store().all().size(); ++i) {
    const Tensor<float>& t = full.session.pipeline->store().all()[i];
    if (!t.learned()) continue;
    const float* const of_halved = halved.session.pipeline->store().all()[i].moment1.data();
    const float* const of_light = light.session.pipeline->store().all()[i].moment1.data();
    double largest = 0;
    for (std::int64_t e = 0; e < t.size(); ++e) {
      ASSERT_EQ(of_halved[e], 0.5F * t.moment1.data()[e]) << t.name << ' ' << e;
      ASSERT_TRUE(!t.rule.semantic || of_halved[e] == of_light[e]) << t.name << ' ' << e;
      largest = std::max<double>(largest, std::abs(of_halved[e]));
    }
    EXPECT_GT(largest, 0) << t.name;
    semantic += t.rule.semantic ? 1 : 0;
  }
  EXPECT_GT(semantic, 0);
}

TEST(CudaGradientHook, AnErrorEndsTheStepAndChangesNothing) {
  SEMFIELD_NEEDS_DEVICE();
  Registry registry = make_registry();
  Subject plain(hash_config(), "cuda", registry), hooked(hash_config(), "cuda", registry);
  plain.to(5);
  hooked.to(5);
  hooked.call([](const StepGradients<float>& gradients) {
    if (gradients.step == 7) throw Error(ErrorKind::failure, "test.error.made", "rank 3 is gone", "start it again");
  });
  EXPECT_HAS(error_of([&] { hooked.to(10); }), "rank 3 is gone");
  EXPECT_EQ(hooked.trainer.step(), 7);
  hooked.call(nullptr);
  plain.to(9);
  hooked.to(9);
  EXPECT_EQ(plain.bits(), hooked.bits());
}

TEST(CudaDevices, AnOrdinalThatIsNotThereIsRefusedWithThoseThatAre) {
  SEMFIELD_NEEDS_DEVICE();
  Registry registry = make_registry();
  const std::string missing = "cuda:" + std::to_string(devices());
  EXPECT_HAS(error_of(ErrorKind::unavailable, [&] { const Subject run(hash_config(), missing, registry); }),
             "runtime.device: " + missing + ": this machine has ", "cuda:" + std::to_string(devices() - 1))
      << missing;
}

TEST(CudaDevices, TheCallersDeviceIsLeftAsItWas) {
  SEMFIELD_NEEDS_DEVICE();
  Registry registry = make_registry();
  for (int ordinal = 0; ordinal < std::min(devices(), 2); ++ordinal) {
    Subject run(hash_config(), "cuda:" + std::to_string(ordinal), registry);
    EXPECT_EQ(run.session.pipeline->executor().device(), (DeviceId{Device::cuda, ordinal}));
    run.to(4);
    int current = -1;
    EXPECT_EQ(cudaGetDevice(&current), cudaSuccess);
    EXPECT_EQ(current, 0);
  }
}

// Of equal devices; a run goes on on another one.
TEST(CudaDevices, TwoDevicesOfAKindGiveTheSameBitsAndTakeOverFromEachOther) {
  SEMFIELD_NEEDS_DEVICE();
  if (devices() < 2) GTEST_SKIP() << "this machine has one device";
  Registry registry = make_registry();
  for (const char* precision : {"", ", precision: bf16"}) {
    const std::string first = std::string("cuda:0") + precision, second = std::string("cuda:1") + precision;
    Subject a(hash_config(), first, registry), b(hash_config(), second, registry);
    a.to(20);
    b.to(20);
    EXPECT_EQ(a.bits(), b.bits()) << precision;
    const TempDir dir;
    write_safetensors(dir / "state.safetensors", a.trainer.state(), {});
    Subject c(hash_config(), second, registry);
    c.trainer.load(TensorFile::read(dir / "state.safetensors"), 20);
    a.to(40);
    c.to(40);
    EXPECT_EQ(a.bits(), c.bits()) << precision;
  }
}

// Device memory: what is copied there comes back, arenas and launches.

TEST(CudaMemory, MatricesComeBackAndTheirSurroundingsAreWatched) {
  SEMFIELD_NEEDS_DEVICE();
  const std::vector<float> values = testing::random_floats(33 * 3, 1, -1, 1);
  const DeviceMatrix<float> matrix(values, 3, 5);
  EXPECT_EQ(matrix.read(), values);
  EXPECT_EQ(matrix.surroundings(), "");
  cuda::check(cudaMemset(matrix.data() + 3, 0, sizeof(float)), "writing into a gap");
  EXPECT_NE(matrix.surroundings(), "");
}

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

TEST(CudaLaunch, AFaultIsTakenOutOfItsCellOnce) {
  SEMFIELD_NEEDS_DEVICE();
  DeviceLaunch launch(true);
  EXPECT_EQ(launch.take_fault(), std::nullopt);
  launch.set_fault((cuda::FaultKey{4} << cuda::kFaultRowBits) | 77);
  EXPECT_EQ(cuda::first_fault_row(cuda::Stage::density), -1);  // another stage's
  EXPECT_EQ(cuda::first_fault_row(static_cast<cuda::Stage>(4)), 77);
  EXPECT_EQ(launch.take_fault(), std::nullopt);
}

}  // namespace
}  // namespace semfield
