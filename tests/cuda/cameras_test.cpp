// Corrections of training cameras on the device against the CPU's.
#include "cuda/stages.h"
#include "device_fixture.h"
#include "model/camera_corrections.h"
#include "testkit/compare.h"

namespace semfield {
namespace {

using testing::DeviceMatrix;
using testing::random_floats;

constexpr std::int64_t kRays = 1000, kCameras = 37;

std::vector<float> cameras() {
  std::vector<float> of_ray;
  for (std::int64_t r = 0; r < kRays; ++r)
    of_ray.push_back(static_cast<float>(r * r % (kCameras - 2)));  // two see none
  return of_ray;
}
std::vector<double> doubles(std::int64_t count, std::uint64_t seed) {
  std::vector<double> values;
  for (const float x : random_floats(count, seed, -1, 1)) values.push_back(static_cast<double>(x));
  return values;
}

template <class T>
View<T> host(std::vector<T>& values, std::int32_t cols) {
  return {values.data(), static_cast<std::int64_t>(values.size()) / cols, cols};
}

template <class T>
void expect_close(const std::vector<T>& got, const std::vector<T>& want, double tolerance) {
  ASSERT_EQ(got.size(), want.size());
  for (std::size_t i = 0; i < want.size(); ++i)
    ASSERT_NEAR(got[i], want[i], tolerance * std::max<double>(1, std::abs(want[i]))) << "element " << i;
}

TEST(CudaCameras, MoveRaysAndGiveGradientsAsTheCpuDoes) {
  SEMFIELD_ON_DEVICE(launch);
  const CameraKernels<float>&cpu = cpu_camera_kernels<float>(), &gpu = cuda::camera_kernels();
  std::vector<float> camera = cameras(), pose = random_floats(kCameras * kPoseNumbers, 5, -0.3, 0.3);
  std::vector<double> origin = doubles(3 * kRays, 6), direction = doubles(3 * kRays, 7);
  const DeviceMatrix<float> d_camera(camera, 1), d_pose(pose, kPoseNumbers);
  const DeviceMatrix<double> d_origin(origin, 3, 4), d_direction(direction, 3, 5);
  gpu.move(d_camera.read_only(), d_pose.read_only(), 2.5, d_origin.view(), d_direction.view());
  cpu.move(host(camera, 1), host(pose, kPoseNumbers), 2.5, host(origin, 3), host(direction, 3));
  expect_close(d_origin.read(), origin, 1e-12);
  expect_close(d_direction.read(), direction, 1e-12);

  std::vector<float> d_ray = random_floats(6 * kRays, 8, -1, 1), gradient = random_floats(pose.size(), 9, -1, 1);
  const DeviceMatrix<float> there(d_ray, 6), sums(gradient, kPoseNumbers);
  gpu.move_backward(d_camera.read_only(), d_pose.read_only(), 2.5, d_direction.read_only(), there.read_only(),
                    sums.view());
  cpu.move_backward(host(camera, 1), host(pose, kPoseNumbers), 2.5, host(direction, 3), host(d_ray, 6),
                    host(gradient, kPoseNumbers));
  expect_close(sums.read(), gradient, 1e-4);
  EXPECT_EQ(d_origin.surroundings() + d_direction.surroundings() + sums.surroundings(), "");
}

TEST(CudaCameras, ChangeColoursAndGiveGradientsAsTheCpuDoes) {
  SEMFIELD_ON_DEVICE(launch);
  const CameraKernels<float>&cpu = cpu_camera_kernels<float>(), &gpu = cuda::camera_kernels();
  std::vector<float> camera = cameras(), map = random_floats(kCameras * kColorNumbers, 5, -0.3, 0.3);
  std::vector<float> color = random_floats(3 * kRays, 6, 0, 1), shown(color.size()), d_color(color.size());
  std::vector<float> d_shown = random_floats(3 * kRays, 7, -1, 1), d_map = random_floats(map.size(), 8, -1, 1);
  const DeviceMatrix<float> t_camera(camera, 1), t_map(map, kColorNumbers), t_color(color, 3), t_shown(kRays, 3),
      t_d_shown(d_shown, 3), t_d_color(kRays, 3, 4), t_d_map(d_map, kColorNumbers);
  gpu.show(t_camera.read_only(), t_map.read_only(), t_color.read_only(), t_shown.view());
  gpu.show_backward(t_camera.read_only(), t_map.read_only(), t_color.read_only(), t_d_shown.read_only(),
                    t_d_color.view(), t_d_map.view());
  cpu.show(host(camera, 1), host(map, kColorNumbers), host(color, 3), host(shown, 3));
  cpu.show_backward(host(camera, 1), host(map, kColorNumbers), host(color, 3), host(d_shown, 3), host(d_color, 3),
                    host(d_map, kColorNumbers));
  expect_close(t_shown.read(), shown, 1e-6);
  expect_close(t_d_color.read(), d_color, 1e-6);
  expect_close(t_d_map.read(), d_map, 1e-4);
  EXPECT_EQ(t_d_color.surroundings() + t_d_map.surroundings(), "");
}

TEST(CudaCameras, KeepTheMeanAsTheCpuDoes) {
  SEMFIELD_ON_DEVICE(launch);
  const CameraKernels<float>&cpu = cpu_camera_kernels<float>(), &gpu = cuda::camera_kernels();
  for (const std::int64_t rows : {1, 37, 300}) {
    const double share = rows == 37 ? 0 : 1;
    std::vector<float> from = random_floats(rows * kPoseNumbers, 3, -1, 2), to(from.size()), sum(from.size(), 0.5F);
    const DeviceMatrix<float> t_from(from, kPoseNumbers), t_to(rows, kPoseNumbers), t_sum(sum, kPoseNumbers);
    gpu.centre(t_from.read_only(), share, t_to.view());
    gpu.centre_backward(t_from.read_only(), share, t_sum.view());
    cpu.centre(host(from, kPoseNumbers), share, host(to, kPoseNumbers));
    cpu.centre_backward(host(from, kPoseNumbers), share, host(sum, kPoseNumbers));
    expect_close(t_to.read(), to, 1e-6);
    expect_close(t_sum.read(), sum, 1e-6);
  }
}

TEST(CudaCameras, RaysGetTheGradientsOfTheirSamples) {
  SEMFIELD_ON_DEVICE(launch);
  constexpr std::int64_t kUnused = 11;
  std::vector<std::int32_t> first{0}, ray;
  for (std::int64_t r = 0; r < kRays; ++r) {
    ray.insert(ray.end(), static_cast<std::size_t>(r * 11 % 71), static_cast<std::int32_t>(r));
    first.push_back(static_cast<std::int32_t>(ray.size()));
  }
  const auto used = static_cast<std::int64_t>(ray.size()), all = used + kUnused;
  std::vector<float> t = random_floats(all, 1, 0.1, 9), delta(t.size(), 0.1F), dx = random_floats(3 * all, 2, -1, 1);
  ray.resize(t.size(), kRays - 1);
  std::vector<double> origin = doubles(3 * kRays, 3), direction = doubles(3 * kRays, 4);
  const DeviceMatrix<std::int32_t> t_first(first, 1), t_ray(ray, 1);
  const DeviceMatrix<float> t_t(t, 1), t_delta(delta, 1), t_dx(dx, 3);
  const DeviceMatrix<double> t_origin(origin, 3), t_direction(direction, 3);
  for (const bool contracted : {false, true}) {
    const DomainMap map = DomainMap::make(Domain::unit_cube, {{-1, -2, 0}, {2, 1, 2}}, 0, contracted);
    std::vector<float> d_ray = random_floats(6 * kRays, 5, -1, 1);
    const DeviceMatrix<float> t_d_ray(d_ray, 6);
    cuda::stages().locate_backward({t_origin.read_only(), t_direction.read_only(), {}},
                                   {t_t.view(), t_delta.view(), t_ray.view(), t_first.view(), all}, map,
                                   t_dx.read_only(), t_d_ray.view());
    cpu_stages<float>().locate_backward({host(origin, 3), host(direction, 3), {}},
                                        {host(t, 1), host(delta, 1), host(ray, 1), host(first, 1), used}, map,
                                        host(dx, 3), host(d_ray, 6));
    expect_close(t_d_ray.read(), d_ray, 1e-4);
    EXPECT_EQ(t_d_ray.surroundings(), "");
  }
}

}  // namespace
}  // namespace semfield
