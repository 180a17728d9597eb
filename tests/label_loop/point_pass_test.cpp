// Semantics of points apart from rays: the logits of a ray's sample, gradients of head and branch alone, and tensors
// that start anew.
#include "core/rng.h"
#include "session/trainer.h"
#include "testkit/compare.h"
#include "tests/session/oracle.h"

namespace semfield {
namespace {

using namespace testing_train;

const std::string kBranch =
    "position: {type: frequency, frequencies: 3}, field: {type: tiny_mlp, hidden_width: 12, hidden_layers: 2}";

// `branch`: the body of the pass's section `semantic`, "" for none.
std::string config_of(const std::string& branch, const std::string& more = "") {
  return stratified_config("type: analytic_room", branch.empty() ? "" : "    semantic: {" + branch + "}\n", "rays: 24",
                           more);
}

const std::string kForms[] = {"", kBranch, kBranch + ", reads_feature: false"};

// Places within the room.
std::vector<double> places(std::int64_t count) {
  const RandomAddress random{5, 0, stream_id("point_pass_test")};
  std::vector<double> out;
  for (std::int64_t i = 0; i < 3 * count; ++i)
    out.push_back(1.8 * static_cast<double>(uniform01(random, static_cast<std::uint64_t>(i))) - 0.9);
  return out;
}

template <class Real>
std::vector<Real> rows_of(const Pass<Real>& pass, std::vector<double> at) {
  Workspace arena;
  StepContext ctx{.workspace = &arena};
  const auto count = std::ssize(at) / 3;
  std::vector<Real> rows(static_cast<std::size_t>(count * pass.point_dims()));
  pass.point_rows(ctx, {at.data(), count, 3}, {rows.data(), count, pass.point_dims()});
  return rows;
}

struct Asking {
  bool training = false;
  std::int64_t step = 0, first = 0;
};

template <class Real>
std::vector<Real> logits_of(const Pass<Real>& pass, std::vector<Real> rows, const Asking& asking = {}) {
  Workspace arena;
  StepContext ctx{
      .seed = 3, .step = asking.step, .training = asking.training, .first_ray = asking.first, .workspace = &arena};
  const std::int64_t count = std::ssize(rows) / pass.point_dims();
  const std::int32_t classes = pass.parts().head->width();
  std::vector<Real> logits(static_cast<std::size_t>(count * classes));
  (void)pass.point_forward(ctx, 0, {rows.data(), count, pass.point_dims()}, {logits.data(), count, classes});
  return logits;
}

// With the class layer before compositing, a pass shows the logits of every sample: those of a ray that has this
// sample alone, with weight 1.
TEST(PointPass, LogitsAreThoseOfASampleOfWeightOne) {
  for (const std::string& form : kForms) {
    SCOPED_TRACE(form);
    Registry registry = make_registry();
    Oracle oracle(config_of(form.empty() ? "" : form + ", least_weight: 0",
                            "runtime: {deferred_class_layer: false, tile_rays: 24, lanes: 1}\n"),
                  registry);
    const Pass<double>& pass = oracle.pipeline->passes().back();
    Workspace arena;
    StepContext ctx{.workspace = &arena};
    oracle.pipeline->derive(0);
    const RayBatch batch = oracle.batch.view(true);
    const PassTrace<double> trace =
        pass.forward(ctx, 0, {batch.origin, batch.direction, batch.near_far}, nullptr, 0, {batch.origin.rows});
    const std::int64_t count = trace.semantic.sample_rows.rows;
    ASSERT_GT(count, 100);
    std::vector<double> at;
    for (std::int64_t k = 0; k < count; ++k) {
      const std::int64_t sample = form.empty() ? k : trace.semantic.branch.source(k, 0);
      const std::int32_t ray = trace.samples.ray_of_sample(sample, 0);
      for (int axis = 0; axis < 3; ++axis)
        at.push_back(batch.origin(ray, axis) + trace.samples.t(sample, 0) * batch.direction(ray, axis));
    }
    const std::vector<double> logits = logits_of(pass, rows_of(pass, at));
    double largest = 0;
    for (std::int64_t k = 0; k < count; ++k) {
      for (std::int32_t c = 0; c < trace.semantic.sample_rows.cols; ++c) {
        const double expected = trace.semantic.sample_rows(k, c);
        largest = std::max(largest, std::abs(expected));
        ASSERT_NEAR(logits[k * trace.semantic.sample_rows.cols + c], expected, 1e-9) << k;
      }
    }
    EXPECT_GT(largest, 1e-3);
  }
}

TEST(PointPass, GradientsAreThoseOfFiniteDifferencesAndNoneReachesTheField) {
  for (const std::string& form : {kForms[0], kForms[1], kForms[2], kBranch + ", dropout: 0.3"}) {
    SCOPED_TRACE(form);
    Registry registry = make_registry();
    Oracle oracle(config_of(form), registry);
    const Pass<double>& pass = oracle.pipeline->passes().back();
    ParamStore<double>& store = oracle.pipeline->store();
    oracle.pipeline->derive(0);
    std::vector<double> rows = rows_of(pass, places(40));
    const std::int32_t classes = pass.parts().head->width();
    std::vector<double> d(static_cast<std::size_t>(40 * classes)), logits(d.size());
    for (std::size_t i = 0; i < d.size(); ++i) d[i] = std::sin(1.7 * static_cast<double>(i));
    const View<double> all(rows.data(), 40, pass.point_dims());
    const auto evaluate = [&](bool backward) {
      Workspace arena;
      StepContext ctx{.seed = 3, .training = true, .workspace = &arena};
      pass.derive(ctx);
      const PointTrace<double> trace = pass.point_forward(ctx, 0, all, {logits.data(), 40, classes});
      if (backward) {
        pass.point_backward(ctx, 0, trace, {d.data(), 40, classes});
        store.reduce_lanes();
        pass.derive_backward(ctx);
      }
      double sum = 0;
      for (std::size_t i = 0; i < d.size(); ++i) sum += d[i] * logits[i];
      return sum;
    };
    evaluate(true);
    int checked = 0;
    for (Tensor<double>& tensor : store.all()) {
      if (tensor.grad.size() == 0) continue;
      const std::vector<double> found(tensor.grad.data(), tensor.grad.data() + tensor.grad.size());
      if (!tensor.rule.semantic) {
        EXPECT_EQ(found, std::vector<double>(found.size(), 0.0)) << tensor.name;
        continue;
      }
      if (!tensor.learned()) continue;
      EXPECT_NE(found, std::vector<double>(found.size(), 0.0)) << tensor.name;
      testkit::GradientCheck options{.max_elements = 12};
      EXPECT_EQ(testkit::check_gradient([&] { return evaluate(false); }, tensor.view(tensor.value),
                                        {found.data(), tensor.spec.rows, tensor.spec.cols}, options),
                "")
          << tensor.name;
      ++checked;
    }
    EXPECT_GE(checked, form.empty() ? 4 : 8);
  }
}

TEST(PointPass, DropoutIsForTrainingAlone) {
  Registry registry = make_registry();
  const Oracle with(config_of(kBranch + ", dropout: 0.4"), registry), without(config_of(kBranch), registry);
  const Pass<double>&drops = with.pipeline->passes().back(), &plain = without.pipeline->passes().back();
  with.pipeline->derive(0);
  without.pipeline->derive(0);
  const std::vector<double> rows = rows_of(plain, places(20)), expected = logits_of(plain, rows);
  EXPECT_EQ(rows_of(drops, places(20)), rows);
  EXPECT_EQ(logits_of(drops, rows), expected);
  EXPECT_EQ(logits_of(plain, rows, {true, 1}), expected);
  const std::vector<double> first = logits_of(drops, rows, {true, 1}), second = logits_of(drops, rows, {true, 2});
  EXPECT_NE(first, expected);
  EXPECT_NE(first, second);
  EXPECT_EQ(first, logits_of(drops, rows, {true, 1}));
}

// The same bits in one call and in many, with dropout too: it is addressed by a point's number.
TEST(PointPass, RowsDoNotDependOnHowABatchIsSplit) {
  for (const std::string& form : {kForms[0], kForms[1], kForms[2], kBranch + ", dropout: 0.3"}) {
    SCOPED_TRACE(form);
    const Session session = open_text(config_of(form));
    const Pass<float>& pass = session.pipeline->passes().back();
    session.pipeline->derive(0);
    const std::vector<double> at = places(83);
    const std::vector<float> rows = rows_of(pass, at);
    const auto dims = static_cast<std::size_t>(pass.point_dims());
    for (const bool training : {false, true}) {
      const std::vector<float> whole = logits_of(pass, rows, {training, 4});
      const auto classes = whole.size() / 83;
      for (const std::size_t size : {1, 7, 32, 64}) {
        for (std::size_t begin = 0; begin < 83; begin += size) {
          const std::size_t end = std::min<std::size_t>(83, begin + size);
          const auto cut = [&](const auto& all, std::size_t width) {
            return std::vector(all.begin() + static_cast<std::ptrdiff_t>(begin * width),
                               all.begin() + static_cast<std::ptrdiff_t>(end * width));
          };
          ASSERT_EQ(rows_of(pass, cut(at, 3)), cut(rows, dims));
          ASSERT_EQ(logits_of(pass, cut(rows, dims), {training, 4, static_cast<std::int64_t>(begin)}),
                    cut(whole, classes));
        }
      }
    }
    EXPECT_TRUE(rows_of(pass, {}).empty());
  }
}

TEST(PointPass, RestartedTensorsAreThoseOfTheBeginning) {
  for (const std::string& yaml : {config_of(""), config_of(kBranch), two_pass_config()}) {
    Session session = open_text(yaml), fresh = open_text(yaml);
    ParamStore<float>& store = session.pipeline->store();
    const std::uint32_t start = fingerprint(store);
    const auto rays = session.make_ray_source();
    Trainer trainer(*session.pipeline, *rays, session.config.adam, session.config.schedule);
    for (int i = 0; i < 3; ++i) trainer.advance();
    EXPECT_NE(fingerprint(store), start);
    for (Tensor<float>& tensor : store.all()) {
      if (!tensor.learned()) continue;
      store.restart(tensor);
      const Tensor<float>& first = *fresh.pipeline->store().find(tensor.name);
      for (std::size_t i = 0; i < tensor.value.size(); ++i) {
        ASSERT_EQ(tensor.value.data()[i], first.value.data()[i]) << tensor.name;
        ASSERT_EQ(tensor.moment1.data()[i], 0) << tensor.name;
        ASSERT_EQ(tensor.moment2.data()[i], 0) << tensor.name;
      }
    }
  }
}

}  // namespace
}  // namespace semfield
