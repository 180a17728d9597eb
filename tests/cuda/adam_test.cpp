// Adam on the device against the CPU's: the same bits where that one has fused multiply-add.
#include "compute/isa.h"
#include "cuda/kernels/kernels.h"
#include "device_fixture.h"
#include "model/param_store.h"

namespace semfield {
namespace {

using AdamTensor = AdamTensor<float>;
using cuda::Stage;
using testing::DeviceMatrix;
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

TEST(CudaAdam, AFaultOfAnyStageLeavesAllAlone) {
  SEMFIELD_ON_DEVICE(launch);
  const Model model({{64, 3}, {4097, 2, true}});
  launch.set_cell(cell_of(adam_step({}, kRate, 0), 0));
  launch.set_fault((static_cast<cuda::FaultKey>(Stage::density) << cuda::kFaultRowBits) | 3);
  model.check();
  model.update();
  for (const auto& twin : model.twins) {
    EXPECT_EQ(twin->back(twin->there_value), twin->value);
    EXPECT_EQ(twin->back(twin->there_m), twin->m);
    EXPECT_EQ(twin->back(twin->there_v), twin->v);
    EXPECT_EQ(twin->back(twin->there_grad), twin->grad);
  }
  EXPECT_EQ(launch.take_fault(), (NotedFault{Stage::density, 3}));
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
