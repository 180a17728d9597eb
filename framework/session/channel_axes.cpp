#include "session/channel_axes.h"

#include <fmt/format.h>

#include <Eigen/Eigenvalues>
#include <algorithm>

#include "compute/parallel.h"
#include "core/check.h"
#include "core/error.h"
#include "session/session.h"

namespace semfield {

namespace {

using Matrix = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>;
using Floats = Eigen::Matrix<float, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>;

constexpr std::int64_t kMostCells = 65536, kRowsAtOnce = 4096;

std::int64_t cells_of(const FrameChannel& map) { return std::int64_t{map.height} * map.width; }

std::vector<FrameChannel*> maps_of(Session& s, const std::string& channel) {
  std::vector<FrameChannel*> maps;
  for (const int f : s.scene.frames_of(Split::train)) {
    for (FrameChannel& one : s.scene.frames[static_cast<std::size_t>(f)].channels)
      if (one.name == channel && !one.values.empty()) maps.push_back(&one);
  }
  return maps;
}

}  // namespace

std::vector<float> principal_axes(const std::vector<const FrameChannel*>& maps, std::int32_t width) {
  std::int64_t cells = 0;
  for (const FrameChannel* map : maps) cells += cells_of(*map);
  const std::int64_t step = std::max<std::int64_t>(1, (cells + kMostCells - 1) / kMostCells);
  const std::int32_t cols = maps.empty() ? width : maps.front()->cols;
  Matrix moment = Matrix::Zero(cols, cols), rows(kRowsAtOnce, cols);
  std::int64_t filled = 0, counted = 0;
  const auto add = [&] {
    moment.selfadjointView<Eigen::Lower>().rankUpdate(rows.topRows(filled).transpose());
    counted += filled;
    filled = 0;
  };
  std::int64_t number = 0;
  for (const FrameChannel* map : maps) {
    for (std::int64_t cell = 0; cell < cells_of(*map); ++cell, ++number) {
      if (number % step != 0) continue;
      const float* const row = map->values.data() + cell * cols;
      const auto value = Eigen::Map<const Eigen::RowVectorXf>(row, cols).cast<double>();
      const double norm = value.norm();
      if (!(norm > 0)) continue;
      rows.row(filled++) = value / norm;
      if (filled == kRowsAtOnce) add();
    }
  }
  add();
  if (counted == 0)
    throw Error(ErrorKind::data, "scene.channel.empty",
                fmt::format("channel '{}': every row that was looked at is zero",
                            maps.empty() ? std::string() : maps.front()->name),
                "write maps whose rows are not all zero, or take the head out of the list `heads`");
  const Eigen::SelfAdjointEigenSolver<Matrix> solver(moment / static_cast<double>(counted));
  std::vector<float> axes(static_cast<std::size_t>(cols) * static_cast<std::size_t>(width));
  for (std::int32_t k = 0; k < width; ++k) {
    const Eigen::VectorXd axis = solver.eigenvectors().col(cols - 1 - k);
    Eigen::Index largest = 0;
    axis.cwiseAbs().maxCoeff(&largest);
    const double sign = axis[largest] < 0 ? -1 : 1;
    for (std::int32_t c = 0; c < cols; ++c)
      axes[static_cast<std::size_t>(c) * static_cast<std::size_t>(width) + static_cast<std::size_t>(k)] =
          static_cast<float>(sign * axis[c]);
  }
  return axes;
}

void multiply_rows(FrameChannel& map, View<const float> matrix) {
  SEMFIELD_CHECK(map.cols == matrix.rows, "a channel is multiplied by a matrix with a row per column");
  const Eigen::Map<const Floats> from(map.values.data(), cells_of(map), map.cols);
  const Eigen::Map<const Floats> by(matrix.data, matrix.rows, matrix.cols);
  std::vector<float> to(static_cast<std::size_t>(cells_of(map)) * static_cast<std::size_t>(matrix.cols));
  Eigen::Map<Floats>(to.data(), cells_of(map), matrix.cols).noalias() = from * by;
  map.values = std::move(to);
  map.cols = matrix.cols;
}

std::vector<std::vector<float>> axes_of(const Session& session) {
  std::vector<std::vector<float>> all;
  const Pass<float>& pass = session.pipeline->passes().back();
  for (const HeadParts<float>& head : pass.parts().heads) {
    const View<const float> axes = pass.axes(head.channel);
    all.emplace_back(axes.data, axes.data + axes.size());
  }
  return all;
}

bool settle_axes(Session& session) {
  bool any = false;
  const Pass<float>& pass = session.pipeline->passes().back();
  for (const HeadParts<float>& head : pass.parts().heads) {
    const View<float> axes = pass.axes(head.channel);
    const std::vector<FrameChannel*> maps = maps_of(session, head.channel);
    if (axes.empty() || maps.empty()) continue;
    const std::vector<float> found = principal_axes({maps.begin(), maps.end()}, axes.cols);
    std::copy(found.begin(), found.end(), axes.data);
    parallel_for(std::ssize(maps), [&](std::int64_t i) { multiply_rows(*maps[static_cast<std::size_t>(i)], axes); });
    any = true;
  }
  return any;
}

void follow_axes(Session& session, const std::vector<std::vector<float>>& before) {
  const Pass<float>& pass = session.pipeline->passes().back();
  for (std::size_t h = 0; h < before.size(); ++h) {
    const HeadParts<float>& head = pass.parts().heads[h];
    const View<const float> now = pass.axes(head.channel);
    if (now.empty() || std::equal(before[h].begin(), before[h].end(), now.data)) continue;
    // A row y = A^T f on the old axes is f = A y within their span, so A'^T A y on the new ones.
    const Eigen::Map<const Floats> old_axes(before[h].data(), now.rows, now.cols),
        new_axes(now.data, now.rows, now.cols);
    const Floats turn = old_axes.transpose() * new_axes;
    for (FrameChannel* map : maps_of(session, head.channel))
      multiply_rows(*map, View<const float>(turn.data(), now.cols, now.cols));
  }
}

}  // namespace semfield
