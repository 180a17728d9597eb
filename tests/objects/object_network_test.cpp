// The network of objects: gradients against central differences, the same bits on any threads, and that it learns.
#include "objects/object_network.h"

#include <gtest/gtest.h>

#include <cmath>

#include "compute/parallel.h"
#include "plugin/loader.h"
#include "testkit/compare.h"

namespace semfield {
namespace {

const Registry& registry() {
  static const Registry registry = [] {
    Registry filled;
    register_linked_plugins(filled);
    return filled;
  }();
  return registry;
}

std::unique_ptr<Grouping> grouping_of(const std::string& name) {
  const PluginEntry& entry = registry().get(PluginKind::grouping, name);
  return entry.grouping(*entry.new_params());
}

constexpr ObjectNetworkShape kShape{3, 16, 2};
constexpr Box kBox{{-1, -1, -1}, {1, 1, 1}};

// Points on a line; the left and the right half are segments of three views.
struct TwoThings {
  TwoThings() {
    for (int i = 0; i < 40; ++i) positions.push_back({-1 + i / 20.0, 0.2, 0.1 * (i % 3)});
    for (int v = 0; v < 3; ++v) {
      SegmentSights view;
      for (int i = 0; i < 40; ++i) {
        view.point.push_back(i);
        view.segment.push_back(i < 20 ? 0 : 1);
      }
      view.first = {0, 20, 40};
      view.class_of = {kVoid, kVoid};
      sights.push_back(view);
    }
  }
  std::vector<Vec3d> positions;
  std::vector<SegmentSights> sights;
};

TEST(ObjectNetwork, GradientsOfAStepAreThoseOfItsLoss) {
  const TwoThings things;
  const ObjectLearning learning{.views = 2, .view_points = 24};
  const std::unique_ptr<Grouping> assignment = grouping_of("assignment");
  ObjectNetwork<double> net(registry().kernels(), *assignment, kShape, kBox, 3, learning.views);
  (void)net.gradients(things.positions, things.sights, learning, 5);
  for (Tensor<double>& tensor : net.store().all()) {
    if (!tensor.learned()) continue;
    std::vector<double> slope(tensor.grad.data(), tensor.grad.data() + tensor.size());
    const auto loss = [&] { return net.gradients(things.positions, things.sights, learning, 5); };
    EXPECT_EQ(testkit::check_gradient(loss, tensor.view(tensor.value),
                                      {slope.data(), tensor.spec.rows, tensor.spec.cols}, {1e-5, 1e-6, 12, 1}),
              "")
        << tensor.name;
  }
}

TEST(ObjectNetwork, FloatFollowsTheOracle) {
  const TwoThings things;
  const ObjectLearning learning{.views = 2, .view_points = 24};
  const std::unique_ptr<Grouping> contrastive = grouping_of("contrastive");
  ObjectNetwork<double> wide(registry().kernels(), *contrastive, kShape, kBox, 3, learning.views);
  ObjectNetwork<float> narrow(registry().kernels(), *contrastive, kShape, kBox, 3, learning.views);
  const double want = wide.gradients(things.positions, things.sights, learning, 0);
  EXPECT_NEAR(narrow.gradients(things.positions, things.sights, learning, 0), want, 1e-4 * std::abs(want));
}

TEST(ObjectNetwork, HasTheSameBitsOnAnyNumberOfThreads) {
  const TwoThings things;
  const std::unique_ptr<Grouping> contrastive = grouping_of("contrastive");
  std::vector<std::vector<float>> outputs;
  for (const int threads : {1, 2, 3}) {
    set_thread_count(threads);
    ObjectNetwork<float> net(registry().kernels(), *contrastive, kShape, kBox, 3, 5);
    net.learn(things.positions, things.sights, {.steps = 20, .views = 5, .view_points = 32}, {});
    outputs.push_back(net.outputs(things.positions));
  }
  set_thread_count(0);
  EXPECT_EQ(outputs[0], outputs[1]);
  EXPECT_EQ(outputs[0], outputs[2]);
}

TEST(ObjectNetwork, TellsTwoThingsApart) {
  const TwoThings things;
  for (const std::string& name : registry().names(PluginKind::grouping)) {
    const std::unique_ptr<Grouping> grouping = grouping_of(name);
    ObjectNetwork<float> net(registry().kernels(), *grouping, kShape, kBox, 3, 4);
    net.learn(things.positions, things.sights, {.steps = 150, .views = 4, .view_points = 64}, {});
    std::vector<float> rows = net.outputs(things.positions);
    const std::int32_t width = grouping->width();
    const View<float> place(rows.data(), std::ssize(things.positions), width);
    grouping->place(place);
    const auto way = [&](int a, int b) {
      double sum = 0;
      for (std::int32_t d = 0; d < width; ++d) sum += std::pow(static_cast<double>(place(a, d) - place(b, d)), 2);
      return std::sqrt(sum);
    };
    EXPECT_LT(way(3, 12), 0.5) << name;
    EXPECT_LT(way(25, 36), 0.5) << name;
    EXPECT_GT(way(8, 31), 1) << name;
  }
}

TEST(ObjectNetwork, NoSegmentIsAnError) {
  const std::unique_ptr<Grouping> contrastive = grouping_of("contrastive");
  ObjectNetwork<float> net(registry().kernels(), *contrastive, kShape, kBox, 3, 4);
  const std::vector<Vec3d> one{{0, 0, 0}};
  EXPECT_THROW(net.learn(one, std::vector<SegmentSights>(2), {}, {}), Error);
}

}  // namespace
}  // namespace semfield
