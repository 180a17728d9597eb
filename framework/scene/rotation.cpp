#include "scene/rotation.h"

#include <Eigen/Geometry>
#include <Eigen/SVD>

namespace semfield {
namespace {

using Matrix = Eigen::Matrix<double, 3, 3, Eigen::RowMajor>;

Eigen::Map<Matrix> matrix_of(Pose& pose) { return Eigen::Map<Matrix>(pose.r[0].data()); }

}  // namespace

void make_rotation(Pose& pose) {
  const Eigen::JacobiSVD<Eigen::Matrix3d> svd(matrix_of(pose), Eigen::ComputeFullU | Eigen::ComputeFullV);
  const Eigen::Matrix3d near = svd.matrixU() * svd.matrixV().transpose();
  // The factors are orthonormal to about 4e-15; a step of Newton's iteration (Higham 1986) leaves less than 1e-15.
  matrix_of(pose) = 0.5 * near * (3 * Eigen::Matrix3d::Identity() - near.transpose() * near);
}

Quaternion quaternion_of(const Pose& pose) {
  const Eigen::Quaterniond q(Eigen::Matrix3d(Eigen::Map<const Matrix>(pose.r[0].data())));
  return {q.w(), q.x(), q.y(), q.z()};
}

void set_rotation(Pose& pose, const Quaternion& turn) {
  Eigen::Quaterniond q(turn[0], turn[1], turn[2], turn[3]);
  q.coeffs() /= q.norm();  // normalized() would leave a zero one as it is
  matrix_of(pose) = q.toRotationMatrix();
}

}  // namespace semfield
