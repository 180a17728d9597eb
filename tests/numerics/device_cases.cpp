// I01 to I05 and the kernels' part of I07 on a device beside the CPU, one call of a plugin at a time.
#include <algorithm>

#include "backend_parts.h"
#include "encoder_box.h"
#include "testkit/field_bench.h"
#include "testkit/host_twin.h"

namespace semfield::numerics {

namespace {

constexpr std::int64_t kRows = 40;

EncoderBuild on_device() { return EncoderBuild{.device = Device::cuda}; }

// An encoder on the device as one on the host, with its tensors.
struct DeviceEncoder {
  DeviceEncoder(const DeviceUnderTest& device, const std::string& name, const testkit::Settings& settings)
      : there(make_encoder<float>(device.registry, name, settings, on_device())),
        here(*there, {device.calls, false}),
        box(here, 1, 1.0),
        workspace(device.calls.memory) {}
  std::vector<float> forward(const std::vector<double>& x) {
    const EncoderTraits shape = here.traits();
    const auto rows = static_cast<std::int64_t>(x.size()) / shape.in_dims;
    std::vector<float> y(static_cast<std::size_t>(rows * shape.out_dims), -99.0F);
    here.forward(context(), box.tensors(), {x.data(), rows, shape.in_dims}, {y.data(), rows, shape.out_dims});
    return y;
  }
  StepContext context() { return StepContext{.workspace = &workspace}; }

  std::unique_ptr<Encoder<float>> there;
  testkit::HostEncoder here;
  testkit::TensorBox<float> box;
  Workspace workspace;
};

struct Kind {
  const char* name;
  testkit::Settings settings;
};
const std::vector<Kind>& kinds() {
  static const std::vector<Kind> all{
      {"identity", {}},
      {"frequency", {{"frequencies", "10"}}},
      {"hash_grid", {{"levels", "4"}, {"log2_entries", "9"}, {"base_resolution", "4"}, {"finest_resolution", "32"}}}};
  return all;
}

std::vector<double> positions(std::int64_t rows) {
  Numbers numbers(31);
  std::vector<double> x(static_cast<std::size_t>(3 * rows));
  for (double& v : x) v = numbers.in(0.02, 0.98);
  return x;
}

// A field whose first trunk layers meet NaN in one row: it stays in that row, and no ReLU hides it.
void nan_through_a_field(CaseRun& run, const DeviceUnderTest& device, const std::string& name, Precision precision) {
  const PluginEntry& entry = device.registry.get(PluginKind::field, name);
  FieldBuild build{.device = Device::cuda, .position_dims = 16, .direction_dims = 9, .precision = precision};
  const auto there = entry.field32(*testkit::make_params(entry, {}), build, device.registry.kernels());
  const testkit::HostField here(*there, {device.calls, false});
  testkit::LawOptions options{.scratch = device.calls.memory};
  testkit::FieldBench<float> sound(here, build, kRows, 0, options), bad(here, build, kRows, 0, options);
  constexpr std::int64_t kBad = 17;
  bad.position(kBad, 3) = std::numeric_limits<float>::quiet_NaN();
  sound.forward();
  bad.forward();
  const std::string on = " of " + name + (precision == Precision::bf16 ? " in bf16" : "");
  bool alone = true;
  for (std::int64_t m = 0; m < kRows; ++m) {
    if (m == kBad) continue;
    alone = alone && bad.sigma(m, 0) == sound.sigma(m, 0) && bad.rgb(m, 1) == sound.rgb(m, 1);
  }
  run.expect(alone, "a NaN keeps to its row" + on);
  run.expect(std::isnan(bad.sigma(kBad, 0)) && std::isnan(bad.rgb(kBad, 1)), "no ReLU hides it" + on);
}

}  // namespace

std::optional<DeviceUnderTest> device_row(CaseRun& run, std::string_view precision) {
  run.row(precision);
  std::string why_not = "this build has no CUDA kernels";
  if (!has_cuda_library() || !cuda_available(&why_not)) {
    run.absent(why_not);
    return {};
  }
  DeviceUnderTest device{run.registry(), cuda_library().calls};
  cuda_library().add_kernels(device.registry.kernels());
  return device;
}

void nan_on_device(CaseRun& run) {
  const std::optional<DeviceUnderTest> device = device_row(run);
  if (!device) return;
  for (const char* name : {"tiny_mlp", "nerf_mlp"}) {
    for (const Precision precision : {Precision::fp32, Precision::bf16})
      nan_through_a_field(run, *device, name, precision);
  }
}

void fused_on_device(CaseRun& run) {
  const std::optional<DeviceUnderTest> device = device_row(run);
  if (!device) return;
  const double u = std::numeric_limits<float>::epsilon() / 2;
  for (const Kind& kind : kinds()) {
    DeviceEncoder there(*device, kind.name, kind.settings);
    EncoderBox<float> here(run.registry(), kind.name, kind.settings);
    const std::vector<double> x = positions(2000);
    const std::vector<float> a = there.forward(x), b = here.forward(x);
    double worst = 0, largest = 0;
    for (std::size_t i = 0; i < a.size(); ++i) {
      worst = std::max(worst, std::abs(static_cast<double>(a[i]) - static_cast<double>(b[i])));
      largest = std::max<double>(largest, std::abs(b[i]));
      if (std::isnan(a[i])) worst = a[i];
    }
    run.measure(worst / largest / u, 4, std::string(kind.name) + ", in u of the largest value");
  }
}

void subnormals_on_device(CaseRun& run) {
  const std::optional<DeviceUnderTest> device = device_row(run);
  if (!device) return;
  DeviceEncoder identity(*device, "identity", {});
  std::vector<double> x;
  for (int i = 0; i < 600; ++i) x.push_back((i % 2 == 0 ? 1 : -1) * 0x1p-120 * std::pow(0.9, i));
  const std::vector<float> y = identity.forward(x);
  int subnormal = 0;
  for (std::size_t i = 0; i < x.size(); ++i) {
    run.measure(std::abs(static_cast<double>(y[i]) - static_cast<double>(static_cast<float>(x[i]))), 0,
                "a number that becomes subnormal");
    subnormal += std::fpclassify(y[i]) == FP_SUBNORMAL ? 1 : 0;
  }
  run.expect(subnormal > 100, "subnormal numbers were among them");
}

void sines_on_device(CaseRun& run) {
  const std::optional<DeviceUnderTest> device = device_row(run);
  if (!device) return;
  const DeviceEncoder encoder(*device, "frequency", sine_settings());
  run.measure(worst_sine<float>(encoder.here), 2, "sin and cos, in units of the last place of 1");
}

// Rows of the result lie 600 million elements apart in device memory; only they are brought back.
void long_index_on_device(CaseRun& run) {
  const std::optional<DeviceUnderTest> device = device_row(run);
  if (!device) return;
  constexpr std::int64_t kFew = 5, kStride = 600'000'000;
  const std::vector<double> x = positions(kFew);
  Workspace arena(device->calls.memory);
  std::byte* const given = arena.take_bytes(x.size() * sizeof(double));
  device->calls.to_device(x.data(), given, x.size() * sizeof(double));
  std::byte* far = nullptr;
  try {
    far = arena.take_bytes(static_cast<std::size_t>(kFew * kStride) * sizeof(float));
  } catch (const Error& error) {
    return run.absent(error.message());
  }
  for (const char* name : {"identity", "frequency"}) {  // without tensors
    DeviceEncoder encoder(*device, name, {});
    const std::int32_t cols = encoder.here.traits().out_dims;
    const std::vector<float> near = encoder.forward(x);
    const View<float> y(reinterpret_cast<float*>(far), kFew, cols, kStride, Device::cuda);
    const View<const double> x_there(reinterpret_cast<const double*>(given), kFew, 3, 3, Device::cuda);
    device->calls.run(false, [&] { encoder.there->forward(encoder.context(), {}, x_there, y); });
    std::vector<float> row(static_cast<std::size_t>(cols));
    for (std::int64_t r = 0; r < kFew; ++r) {
      device->calls.to_host(reinterpret_cast<const std::byte*>(y.row(r)), row.data(), row.size() * sizeof(float));
      run.expect(std::memcmp(row.data(), near.data() + r * cols, row.size() * sizeof(float)) == 0,
                 std::string(name) + ": rows up to element 2.4e9 have the bits of packed ones");
    }
  }
}

void encoder_guards_on_device(CaseRun& run, const DeviceUnderTest& device) {
  const double inf = std::numeric_limits<double>::infinity(), nan = std::numeric_limits<double>::quiet_NaN();
  for (const Kind& kind : kinds()) {
    DeviceEncoder encoder(device, kind.name, kind.settings);
    for (const std::size_t row : {0, 31, 32, 39}) {
      for (const double bad : {nan, -nan, inf, -inf}) {
        std::vector<double> x = positions(kRows);
        x[3 * row + row % 3] = bad;
        run.expect_error(ErrorKind::data, {std::string("encoder '") + kind.name + "'", std::to_string(row)},
                         [&] { (void)encoder.forward(x); });
      }
    }
  }
}

}  // namespace semfield::numerics
