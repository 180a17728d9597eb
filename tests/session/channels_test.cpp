// Named channels from a dataset to a loss: read where one wants them, cut with the batch, and said where there are
// none.
#include <ostream>

#include "core/error.h"
#include "session/ray_source.h"
#include "session/settings/choices.h"
#include "session/trainer.h"
#include "tests/session/oracle.h"
#include "tests/session/train_testing.h"

namespace semfield {
namespace {

using namespace testing_train;

const std::string kAlbedo = "losses: [{type: albedo}]\n";

std::string albedo_config(bool offered, const std::string& more) {
  std::string yaml = hash_config(more);
  const std::string scene = "{type: analytic_room";
  return offered ? yaml.replace(yaml.find(scene), scene.size(), scene + ", with_albedo: true") : yaml;
}

// Cell (y / 2, x) of the channel is that of pixel (y, x), and belongs to the ray of that pixel.
TEST(Channels, ADatasetsChannelReachesTheLossThatReadsIt) {
  Registry registry = make_channel_registry();
  const Session session = open_text(albedo_config(true, kAlbedo), registry);
  BatchBuffers batch;
  const std::unique_ptr<RaySource> rays = session.make_ray_source();
  rays->fill(3, batch);
  const std::vector<float>& albedo = batch.of("albedo");
  ASSERT_EQ(albedo.size(), batch.target.size());
  int same = 0, other = 0;
  for (std::size_t r = 0; r < batch.label.size(); ++r) {
    const std::string place = rays->place_of_row(3, static_cast<std::int64_t>(r));
    const bool even = std::stoi(place.substr(place.find("y ") + 2)) % 2 == 0;
    for (std::size_t i = 3 * r; i < 3 * r + 3; ++i) {
      EXPECT_TRUE(!even || albedo[i] == batch.target[i]) << place;
      same += even ? 1 : 0;
      other += !even && albedo[i] != batch.target[i] ? 1 : 0;
    }
  }
  EXPECT_GT(same, 100);
  EXPECT_GT(other, 10) << "odd rows show the row above";
}

TEST(Channels, WhatNoLossReadsIsNotRead) {
  Registry registry = make_channel_registry();
  const Session with = open_text(albedo_config(true, kAlbedo), registry);
  const Session without = open_text(albedo_config(true, ""), registry);
  for (std::size_t f = 0; f < with.scene.frames.size(); ++f) {
    const bool train = with.scene.info.frames[f].split == Split::train;
    EXPECT_EQ(with.scene.frames[f].channels.size(), train ? 1U : 0U);
    EXPECT_TRUE(without.scene.frames[f].channels.empty());
  }
}

TEST(Channels, ALossWithoutItsChannelIsLeftOutAndSaysSo) {
  Registry registry = make_channel_registry();
  const Session session = open_text(albedo_config(false, kAlbedo), registry);
  EXPECT_TRUE(session.config.losses.empty());
  const auto& rows = session.plan.left_out;
  const auto row =
      std::find_if(rows.begin(), rows.end(), [](const LeftOut& r) { return r.component == "loss_albedo"; });
  ASSERT_NE(row, rows.end());
  EXPECT_EQ(row->evidence, "no training frame has 'albedo'");
}

// A second error of all rays against nearly the same colours: gradients of twice that and more.
TEST(Channels, ALossOnAChannelTrains) {
  Registry registry = make_channel_registry();
  Session session = open_text(albedo_config(true, kAlbedo), registry);
  const std::unique_ptr<RaySource> rays = session.make_ray_source();
  Trainer trainer(*session.pipeline, *rays, session.config.adam, session.config.schedule, session.config.train.steps);
  const double first = trainer.advance().terms[0];
  double last = first;
  while (trainer.step() < 60) last = trainer.advance().terms[0];
  EXPECT_GT(first, 0);
  EXPECT_LT(last, 0.5 * first);
}

TEST(RayBatch, RowsCutEveryArrayAndItsCountsOfTiles) {
  std::vector<double> three(30), two(20);
  std::vector<float> color(30), more(40);
  std::vector<std::int16_t> label(10);
  for (std::size_t r = 0; r < 10; ++r) {
    three[3 * r] = two[2 * r] = static_cast<double>(r);
    color[3 * r] = more[4 * r] = static_cast<float>(r);
    label[r] = static_cast<std::int16_t>(r);
  }
  const std::vector<std::int64_t> counts{2, 0, 1};
  RayBatch batch;
  batch.origin = batch.direction = {three.data(), 10, 3};
  batch.near_far = {two.data(), 10, 2};
  batch.targets.color = {color.data(), 10, 3};
  batch.targets.label = {label.data(), 10, 1};
  batch.targets.more.set("more", {more.data(), 10, 4});
  batch.label_only = {counts.data(), 3, 1};
  batch.tile_rays = 4;
  EXPECT_EQ(color_normaliser(batch), 21);
  const RayBatch cut = batch.rows(4, 6), part = cut.rows(4, 2), one = batch.rows(1, 1), late = batch.rows(2, 2);
  EXPECT_EQ(cut.label_only.rows, 2);
  EXPECT_EQ(cut.without_color(), 0);
  EXPECT_EQ(part.origin(0, 0), 8);
  EXPECT_EQ(part.near_far(1, 0), 9);
  EXPECT_EQ(part.targets.more["more"](0, 0), 8);
  EXPECT_EQ(part.targets.label(0, 0), 8);
  EXPECT_EQ(part.without_color(), 1);
  EXPECT_EQ(one.without_color(), 1) << "the second of two";
  EXPECT_EQ(late.without_color(), 0);
  const BatchShape shape = shape_of(batch);
  const RayBatch empty = shape.batch();
  EXPECT_EQ(shape_of(batch), shape);
  EXPECT_FALSE(shape_of(cut) == shape);
  EXPECT_EQ(empty.targets.more.begin()->name, "more");
  EXPECT_EQ(empty.targets.more.begin()->view.cols, 4);
  EXPECT_EQ(empty.origin.cols, 3);
  EXPECT_EQ(empty.targets.label.cols, 1);
}

// The gradient hook: what a program sees and may change between backward and Adam.

// A session with its trainer.
struct Subject {
  Subject(const std::string& yaml, Registry& registry) : session(open_text(yaml, registry)) {}
  void to(std::int64_t step) {
    while (trainer.step() < step) trainer.advance();
  }
  void call(GradientHook<float> hook) { session.pipeline->executor().set_gradient_hook(std::move(hook)); }
  ParamStore<float>& store() { return session.pipeline->store(); }

  Session session;
  std::unique_ptr<RaySource> rays = session.make_ray_source();
  Trainer trainer{*session.pipeline, *rays, session.config.adam, session.config.schedule};
};

TEST(GradientHook, SeesEveryLearnedTensorOfEveryStepAndKeepsTheBits) {
  Registry registry = make_registry();
  for (const std::string& yaml : {hash_config(), two_pass_config()}) {
    Subject plain(yaml, registry), hooked(yaml, registry);
    std::vector<std::int64_t> steps;
    hooked.call([&](const StepGradients<float>& gradients) {
      steps.push_back(gradients.step);
      EXPECT_EQ(gradients.stream, nullptr);
      std::size_t next = 0;
      double sum = 0;
      for (const Tensor<float>& t : hooked.store().all()) {
        if (!t.learned()) continue;
        ASSERT_LT(next, gradients.tensors.size());
        const View<float>& view = gradients.tensors[next++];
        EXPECT_EQ(view.data, t.grad.data()) << t.name;
        EXPECT_EQ(view.rows, t.spec.rows) << t.name;
        EXPECT_EQ(view.cols, t.spec.cols) << t.name;
        EXPECT_EQ(view.device, Device::cpu);
        for (std::int64_t i = 0; i < view.size(); ++i) sum += std::abs(view.data[i]);
      }
      EXPECT_EQ(next, gradients.tensors.size());
      EXPECT_GT(sum, 0);
    });
    plain.to(6);
    hooked.to(6);
    EXPECT_EQ(fingerprint(plain.store()), fingerprint(hooked.store()));
    EXPECT_EQ(steps, (std::vector<std::int64_t>{0, 1, 2, 3, 4, 5}));
    hooked.call(nullptr);
    plain.to(8);
    hooked.to(8);
    EXPECT_EQ(fingerprint(plain.store()), fingerprint(hooked.store()));
    EXPECT_EQ(steps.size(), 6u);
  }
}

// The first moment after the first step is (1 - beta1) times the gradient: unlike the update it keeps its scale. Of the
// fixed losses the semantic one has a weight, and the head learns from it alone.
TEST(GradientHook, HalfOfTheGradientsIsHalfOfTheWeight) {
  Registry registry = make_registry();
  const auto config = [](const std::string& weight) {
    std::string yaml = two_pass_config();
    return yaml.replace(yaml.find("weight: 0.3"), 11, "weight: " + weight);
  };
  Subject full(config("0.25"), registry), halved(config("0.25"), registry), light(config("0.125"), registry);
  halved.call([](const StepGradients<float>& gradients) {
    for (const View<float>& gradient : gradients.tensors) {
      for (std::int64_t i = 0; i < gradient.size(); ++i) gradient.data[i] *= 0.5F;
    }
  });
  for (Subject* run : {&full, &halved, &light}) run->to(1);
  int semantic = 0;
  for (std::size_t i = 0; i < full.store().all().size(); ++i) {
    const Tensor<float>& t = full.store().all()[i];
    if (!t.learned()) continue;
    const float* const of_halved = halved.store().all()[i].moment1.data();
    const float* const of_light = light.store().all()[i].moment1.data();
    for (std::int64_t e = 0; e < t.size(); ++e) {
      ASSERT_EQ(of_halved[e], 0.5F * t.moment1.data()[e]) << t.name << ' ' << e;
      ASSERT_TRUE(!t.rule.semantic || of_halved[e] == of_light[e]) << t.name << ' ' << e;
    }
    semantic += t.rule.semantic ? 1 : 0;
  }
  EXPECT_GT(semantic, 0);
}

TEST(GradientHook, AnErrorEndsTheStepAndChangesNothing) {
  Registry registry = make_registry();
  Subject plain(hash_config(), registry), hooked(hash_config(), registry);
  plain.to(3);
  hooked.to(3);
  hooked.call([](const StepGradients<float>&) {
    throw Error(ErrorKind::failure, "test.error.made", "rank 3 is gone", "start it again");
  });
  try {
    hooked.trainer.advance();
    FAIL() << "the step went on";
  } catch (const Error& error) {
    EXPECT_HAS(error.message(), "rank 3 is gone");
    EXPECT_EQ(error.remedy(), "start it again");
  }
  EXPECT_EQ(hooked.trainer.step(), 3);
  hooked.call(nullptr);
  plain.to(5);
  hooked.to(5);
  EXPECT_EQ(fingerprint(plain.store()), fingerprint(hooked.store()));
}

TEST(GradientHook, WhatItWritesIsChecked) {
  Registry registry = make_registry();
  Subject run(hash_config(), registry);
  run.to(2);
  run.call([](const StepGradients<float>& gradients) { gradients.tensors.back().data[0] = NAN; });
  const std::uint32_t before = fingerprint(run.store());
  EXPECT_THROW(run.trainer.advance(), Error);
  EXPECT_EQ(fingerprint(run.store()), before);
  EXPECT_EQ(run.trainer.step(), 2);
}

// The number of steps that fits into a time, settled from the rate of the steps; seconds are counted, never read.

struct Course {
  double trained_s = 0;
  std::int64_t steps = 0;
  double first_settled_s = 0;
  int settled = 0;
};

/// Steps one after the other, `queued` at a time; step i takes `seconds(i, s)` after s seconds of training.
Course train(double begin_s, double until_s, int queued, const std::function<double(std::int64_t, double)>& seconds) {
  Pace pace(begin_s, until_s);
  Course course;
  std::int64_t step = 0, end = 0;
  double now_s = begin_s;
  while (end == 0 || step < end) {
    for (int i = 0; i < queued && (end == 0 || step < end); ++i) now_s += seconds(step++, now_s);
    if (const auto settled = pace.made(step, now_s, end)) {
      EXPECT_GE(*settled, step);
      end = *settled;
      if (course.settled++ == 0) course.first_settled_s = now_s - begin_s;
    }
  }
  course.trained_s = now_s - begin_s;
  course.steps = step;
  return course;
}

TEST(Pace, EqualStepsAreSettledOnceAfterATenthOfTheTime) {
  const Course course = train(0, 20, 1, [](std::int64_t, double) { return 0.05; });
  EXPECT_EQ(course.settled, 1);
  EXPECT_NEAR(course.first_settled_s, 2, 0.6);
  EXPECT_NEAR(course.trained_s, 20, 0.1);
  EXPECT_EQ(course.steps, 400);
}

TEST(Pace, ALegThatBeginsLaterHasItsOwnTime) {
  const Course course = train(100, 110, 1, [](std::int64_t, double) { return 0.02; });
  EXPECT_NEAR(course.first_settled_s, 1, 0.3);
  EXPECT_NEAR(course.trained_s, 10, 0.1);
}

struct Machine {
  const char* name;
  double time_s;
  int queued, most_settled;
  std::function<double(std::int64_t, double)> seconds;
};

void PrintTo(const Machine& machine, std::ostream* out) { *out << machine.name; }

class PaceOn : public ::testing::TestWithParam<Machine> {};

TEST_P(PaceOn, TheTimeIsMetWithinATenth) {
  const Machine& machine = GetParam();
  const Course course = train(0, machine.time_s, machine.queued, machine.seconds);
  EXPECT_NEAR(course.trained_s, machine.time_s, 0.1 * machine.time_s) << course.settled << " times settled";
  EXPECT_LE(course.first_settled_s, 0.3 * machine.time_s);
  EXPECT_LE(course.settled, machine.most_settled);
}

double noise(std::int64_t step) { return 0.5 + 0.5 * std::sin(static_cast<double>(step * step % 1009)); }

const Machine kMachines[] = {
    // Space empties: a step takes a third of its time in the end.
    {"two_cores", 20, 1, 6,
     [](std::int64_t i, double) { return 0.02 + 0.04 * std::exp(-static_cast<double>(i) / 300); }},
    {"two_cores_for_long", 300, 1, 5,
     [](std::int64_t i, double) { return 0.02 + 0.04 * std::exp(-static_cast<double>(i) / 300); }},
    {"loaded_cores", 20, 1, 2, [](std::int64_t i, double) { return 0.03 + 0.06 * noise(i); }},
    {"load_that_ends", 300, 1, 4, [](std::int64_t, double s) { return s < 120 ? 0.06 : 0.02; }},
    {"load_that_comes", 300, 1, 4, [](std::int64_t, double s) { return s < 120 ? 0.02 : 0.06; }},
    {"load_that_comes_and_goes", 300, 1, 8, [](std::int64_t, double s) { return std::fmod(s, 50) < 25 ? 0.02 : 0.05; }},
    {"gpu", 20, 32, 2, [](std::int64_t i, double) { return i < 4 ? 0.4 : 2.4e-4 + 2e-4 * noise(i); }},
    // It passes, and moves nothing.
    {"a_stall", 20, 1, 1, [](std::int64_t i, double) { return i == 200 ? 0.35 : 0.05; }},
    {"slow_first_step", 10, 1, 2, [](std::int64_t i, double) { return i == 0 ? 2.0 : 0.01; }},
};
INSTANTIATE_TEST_SUITE_P(Machines, PaceOn, ::testing::ValuesIn(kMachines),
                         [](const ::testing::TestParamInfo<Machine>& row) { return row.param.name; });

TEST(Pace, StepsThatTakeMostOfTheTimeEndNearIt) {
  EXPECT_EQ(train(0, 10, 1, [](std::int64_t, double) { return 4.0; }).steps, 3) << "8 s, and 2 s are half a step";
  EXPECT_EQ(train(0, 10, 1, [](std::int64_t, double) { return 60.0; }).steps, 1);
}

TEST(Pace, TheRateIsThatOfTheLastTenth) {
  Pace pace(0, 100);
  EXPECT_EQ(pace.steps_per_s(), 0);
  std::int64_t step = 0;
  double now_s = 0;
  while (now_s < 30) {
    now_s += now_s < 12 ? 1 : 0.25;
    (void)pace.made(++step, now_s, 1000);
  }
  EXPECT_NEAR(pace.steps_per_s(), 4, 1e-9);
}

}  // namespace
}  // namespace semfield
