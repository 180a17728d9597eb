// Groupings on the device against those of the CPU: sums, gradients, and networks that learn.
#include "execution/device_library.h"
#include "objects/object_network.h"
#include "plugin/loader.h"
#include "testkit/compare.h"
#include "tests/cuda/device_fixture.h"

namespace semfield {
namespace {

using testing::DeviceMatrix;

const Registry& registry() {
  static const Registry* const with_device = [] {
    auto* const made = new Registry();
    register_linked_plugins(*made);
    cuda_library().add_kernels(made->kernels());
    return made;
  }();
  return *with_device;
}

std::unique_ptr<Grouping> grouping_of(const std::string& name) {
  const PluginEntry& entry = registry().get(PluginKind::grouping, name);
  return entry.grouping(*entry.new_params());
}

// Points of images whose segments differ in number and size; the last image has one segment alone.
struct Images {
  std::int64_t per_image;
  std::vector<std::int32_t> segment, segments;
  std::vector<float> rows, slow;

  Images(std::int64_t count, std::int64_t points, std::int32_t width) : per_image(points) {
    const RandomAddress random{3, 0, stream_id("groupings_test")};
    for (std::int64_t i = 0; i < count; ++i) {
      segments.push_back(i + 1 == count ? 1 : static_cast<std::int32_t>(3 + 40 * i));
      for (std::int64_t p = 0; p < points; ++p) {
        const double drawn = static_cast<double>(uniform01(random, static_cast<std::uint64_t>(i * points + p)));
        segment.push_back(static_cast<std::int32_t>(drawn * drawn * segments.back()));  // some segments have no point
      }
    }
    rows = testing::random_floats(std::ssize(segment) * width, 1, -1.5, 1.5);
    slow = testing::random_floats(std::ssize(segment) * width, 2, -1.5, 1.5);
  }
};

TEST(CudaGroupings, SumAndGradientsAreTheCpus) {
  SEMFIELD_ON_DEVICE(launch);
  for (const std::string& name : registry().names(PluginKind::grouping)) {
    SCOPED_TRACE(name);
    const std::unique_ptr<Grouping> grouping = grouping_of(name);
    const GroupingKernel kernel = grouping->kernel(Device::cuda, registry().kernels());
    ASSERT_NE(kernel, nullptr);
    const std::int32_t width = grouping->width();
    for (const std::int64_t points : {1, 2, 33, 256, 301}) {
      SCOPED_TRACE(points);
      const std::int64_t count = 4;
      const Images images(count, points, width);
      const DeviceMatrix<float> rows(images.rows, width), slow(images.slow, width),
          gradients(std::vector<float>(images.rows.size(), 0.5F), width);
      const DeviceMatrix<std::int32_t> segment(images.segment, 1), segments(images.segments, 1);
      const DeviceMatrix<double> loss(std::vector<double>(images.segment.size(), 0), 1);
      GroupingCall call;
      call.rows = rows.read_only();
      call.slow = grouping->slow_share() > 0 ? slow.read_only() : rows.read_only();
      call.segment = segment.read_only();
      call.segments = segments.read_only();
      call.per_image = points;
      call.most_segments = 3 + 40 * 2;
      call.scale = 0.3;
      call.gradients = gradients.view();
      call.loss = loss.view();
      kernel(*grouping, call, launch.arena());
      std::vector<double> want(images.rows.size(), 0.5);
      double want_loss = 0;
      const std::vector<double> wide = testing::widen(images.rows), wide_slow = testing::widen(images.slow);
      for (std::int64_t i = 0; i < count; ++i) {
        const auto first = static_cast<std::size_t>(i * points * width);
        const View<const double> own(wide.data() + first, points, width);
        const View<const double> keys(wide_slow.data() + first, points, width);
        want_loss += grouping->add(SegmentedPoints<double>{own, grouping->slow_share() > 0 ? keys : own,
                                                           std::span(images.segment)
                                                               .subspan(static_cast<std::size_t>(i * points),
                                                                        static_cast<std::size_t>(points)),
                                                           images.segments[static_cast<std::size_t>(i)]},
                                   call.scale, View<double>(want.data() + first, points, width));
      }
      const std::vector<float> got = gradients.read();
      for (std::size_t i = 0; i < got.size(); ++i) ASSERT_NEAR(got[i], want[i], 2e-5) << i;
      double got_loss = 0;
      for (const double of_point : loss.read()) got_loss += of_point;
      EXPECT_NEAR(got_loss, want_loss, 1e-5 * (1 + std::abs(want_loss)));
      EXPECT_EQ(gradients.surroundings() + loss.surroundings(), "");
    }
  }
}

// Two bars side by side, each one segment of every view, numbered anew in each.
TEST(CudaGroupings, ANetworkLearnsWhatTheCpuDoesAndRepeatsItsBits) {
  SEMFIELD_NEEDS_DEVICE();
  std::vector<Vec3d> positions;
  for (int i = 0; i < 40; ++i) positions.push_back({i < 20 ? -0.5 : 0.5, 0.05 * (i % 20) - 0.5, 0.1});
  std::vector<SegmentSights> sights(3);
  for (std::size_t v = 0; v < sights.size(); ++v) {
    SegmentSights& view = sights[v];
    for (int s = 0; s < 2; ++s) {
      for (int i = 0; i < 20; ++i) {
        view.point.push_back(20 * (v % 2 == 0 ? s : 1 - s) + i);
        view.segment.push_back(s);
      }
      view.class_of.push_back(kVoid);
    }
    view.first = {0, 20, 40};
  }
  const Box box{{-1, -1, -1}, {1, 1, 1}};
  const ObjectLearning learning{.steps = 25, .views = 4, .view_points = 64};
  for (const std::string& name : registry().names(PluginKind::grouping)) {
    SCOPED_TRACE(name);
    const std::unique_ptr<Grouping> grouping = grouping_of(name);
    std::vector<std::vector<float>> found;
    double said = 0;
    for (const bool on_gpu : {false, true, true}) {
      ObjectNetwork<float> net(registry().kernels(), *grouping, {}, box, 3, learning.views);
      const auto say = [&](double done, double of) { said = done / of; };
      if (on_gpu)
        EXPECT_TRUE(net.learn_on_gpu(0, positions, sights, learning, say));
      else
        net.learn(positions, sights, learning, {});
      found.push_back(net.outputs(positions));
    }
    EXPECT_EQ(said, 1);
    EXPECT_EQ(found[1], found[2]);
    double largest = 0;
    for (std::size_t i = 0; i < found[0].size(); ++i) {
      EXPECT_NEAR(found[1][i], found[0][i], 0.02) << i;
      largest = std::max(largest, std::abs(double{found[0][i]}));
    }
    EXPECT_GT(largest, 0.2) << "nothing was learned";
  }
}

}  // namespace
}  // namespace semfield
