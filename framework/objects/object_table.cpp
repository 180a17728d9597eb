#include "objects/object_table.h"

#include <Eigen/Eigenvalues>
#include <algorithm>
#include <cmath>
#include <map>

#include "compute/parallel.h"
#include "execution/point_network.h"

namespace semfield {

std::vector<std::int16_t> PointClasses::most_probable() const {
  const auto width = static_cast<std::size_t>(classes);
  std::vector<std::int16_t> out(width == 0 ? 0 : probability.size() / width, kVoid);
  for (std::size_t i = 0; i < out.size(); ++i) {
    const auto row = probability.begin() + static_cast<std::ptrdiff_t>(i * width);
    const auto best = std::max_element(row, row + static_cast<std::ptrdiff_t>(width));
    if (*best > 0) out[i] = static_cast<std::int16_t>(best - row);
  }
  return out;
}

PointClasses classes_of_points(Session& session, std::span<const Vec3d> positions,
                               std::span<const SegmentSights> sights) {
  PointClasses out;
  out.classes = std::max(1, session.classes());
  const auto width = static_cast<std::size_t>(out.classes);
  out.probability.assign(positions.size() * width, 0);
  if (!session.pipeline->has_semantics()) {
    for (const SegmentSights& view : sights) {
      for (std::size_t i = 0; i < view.point.size(); ++i) {
        const std::int16_t told = view.class_of[static_cast<std::size_t>(view.segment[i])];
        if (told >= 0 && told < out.classes)
          out.probability[static_cast<std::size_t>(view.point[i]) * width + static_cast<std::size_t>(told)] += 1;
      }
    }
    return out;
  }
  const auto logits = static_cast<std::int32_t>(session.plan.class_of_logit.size());
  std::vector<double> at;
  for (const Vec3d& p : positions) at.insert(at.end(), {p.x, p.y, p.z});
  std::vector<float> found(positions.size() * static_cast<std::size_t>(logits));
  PointQuery<float> query;
  query.position = {at.data(), std::ssize(positions), 3};
  query.logits = {found.data(), std::ssize(positions), logits};
  query_points(*session.pipeline, query);
  parallel_for(std::ssize(positions), [&](std::int64_t n) {
    const auto i = static_cast<std::size_t>(n);
    const float* const row = &found[i * static_cast<std::size_t>(logits)];
    const float most = *std::max_element(row, row + logits);
    double sum = 0;
    for (std::int32_t c = 0; c < logits; ++c) sum += std::exp(static_cast<double>(row[c] - most));
    for (std::int32_t c = 0; c < logits; ++c)
      out.probability[i * width + static_cast<std::size_t>(session.plan.class_of_logit[static_cast<std::size_t>(c)])] =
          static_cast<float>(std::exp(static_cast<double>(row[c] - most)) / sum);
  });
  return out;
}

namespace {

constexpr double kTrim = 0.01;  // of an object's points on each side of its box, which depth throws about

// The box along the principal axes of the points.
TurnedBox box_of(const std::vector<Vec3d>& points, Vec3d mean) {
  Eigen::Matrix3d spread = Eigen::Matrix3d::Zero();
  for (const Vec3d& p : points) {
    const Eigen::Vector3d way(p.x - mean.x, p.y - mean.y, p.z - mean.z);
    spread += way * way.transpose();
  }
  const Eigen::SelfAdjointEigenSolver<Eigen::Matrix3d> solved(spread);
  TurnedBox box;
  for (int k = 0; k < 2; ++k) {
    const Eigen::Vector3d v = solved.eigenvectors().col(2 - k);
    Eigen::Index largest = 0;
    v.cwiseAbs().maxCoeff(&largest);
    const double sign = v(largest) < 0 ? -1 : 1;  // a solver may turn an axis about
    box.axis[static_cast<std::size_t>(k)] = {sign * v(0), sign * v(1), sign * v(2)};
  }
  box.axis[2] = cross(box.axis[0], box.axis[1]);
  box.center = mean;
  for (int k = 0; k < 3; ++k) {
    const Vec3d axis = box.axis[static_cast<std::size_t>(k)];
    std::vector<double> along;
    for (const Vec3d& p : points) along.push_back(dot(p - mean, axis));
    std::sort(along.begin(), along.end());
    const auto cut = static_cast<std::size_t>(kTrim * static_cast<double>(along.size()));
    const double low = along[cut], high = along[along.size() - 1 - cut];
    box.size[k] = high - low;
    box.center = box.center + axis * ((low + high) / 2);
  }
  return box;
}

}  // namespace

void measure_objects(std::span<ObjectRow> rows, std::span<const Vec3d> position, std::span<const std::int32_t> id,
                     double cell_m) {
  std::vector<std::vector<Vec3d>> points(rows.size());
  for (std::size_t i = 0; i < id.size(); ++i)
    if (id[i] > 0) points[static_cast<std::size_t>(id[i]) - 1].push_back(position[i]);
  for (std::size_t o = 0; o < rows.size(); ++o) {
    ObjectRow& row = rows[o];
    row.points = std::ssize(points[o]);
    row.area = static_cast<double>(row.points) * cell_m * cell_m;
    row.centroid = {};
    row.box = {{}, {{{1, 0, 0}, {0, 1, 0}, {0, 0, 1}}}, {}};
    if (points[o].empty()) continue;
    Vec3d sum;
    for (const Vec3d& p : points[o]) sum = sum + p;
    row.centroid = sum * (1 / static_cast<double>(row.points));
    row.box = box_of(points[o], row.centroid);
  }
}

std::vector<ObjectRow> object_table(const ObjectSurface& surface, std::span<const std::int32_t> id,
                                    std::span<const SegmentSights> sights, const PointClasses& classes) {
  const std::int32_t most = id.empty() ? 0 : *std::max_element(id.begin(), id.end());
  std::vector<ObjectRow> rows(static_cast<std::size_t>(most));
  std::vector<std::vector<double>> votes(rows.size(), std::vector<double>(static_cast<std::size_t>(classes.classes)));
  for (std::size_t i = 0; i < id.size(); ++i) {
    if (id[i] == 0) continue;
    const auto o = static_cast<std::size_t>(id[i]) - 1;
    for (std::size_t c = 0; c < votes[o].size(); ++c)
      votes[o][c] += static_cast<double>(classes.probability[i * votes[o].size() + c]);
  }
  for (const SegmentSights& view : sights) {
    std::map<std::int32_t, std::map<std::int32_t, double>> in_segment;  // by object
    for (std::size_t i = 0; i < view.point.size(); ++i)
      if (const std::int32_t o = id[static_cast<std::size_t>(view.point[i])]; o > 0) ++in_segment[o][view.segment[i]];
    for (const auto& [o, of] : in_segment) {
      double all = 0, best = 0;
      for (const auto& [s, n] : of) {
        all += n;
        best = std::max(best, n);
      }
      ObjectRow& row = rows[static_cast<std::size_t>(o) - 1];
      ++row.views;
      row.agreement += best / all;
    }
  }
  for (std::size_t o = 0; o < rows.size(); ++o) {
    ObjectRow& row = rows[o];
    row.id = static_cast<std::int32_t>(o) + 1;
    if (row.views > 0) row.agreement /= row.views;
    double all = 0;
    for (const double v : votes[o]) all += v;
    if (!(all > 0)) continue;
    const auto best = std::max_element(votes[o].begin(), votes[o].end());
    row.class_index = static_cast<std::int16_t>(best - votes[o].begin());
    row.class_probability = *best / all;
  }
  std::vector<Vec3d> positions;
  for (const PoolPoint& point : surface.pool.points) positions.push_back(point.position);
  measure_objects(rows, positions, id, surface.pool.cell_m());
  return rows;
}

}  // namespace semfield
