// Forward dynamics and their derivatives of the chains of benches/mechanisms.rs by pinocchio: one JSON
// line a size. Built and run by benches/mechanisms.sh.
#include <pinocchio/algorithm/aba-derivatives.hpp>
#include <pinocchio/algorithm/aba.hpp>
#include <pinocchio/multibody.hpp>

#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <vector>

using namespace pinocchio;

// Equal rods of 1 kg and 0.5 m along x, about z.
static Model chain(int links) {
  Model model;
  model.gravity.linear(Eigen::Vector3d(0, -9.81, 0));
  JointIndex parent = 0;
  for (int k = 0; k < links; ++k) {
    const SE3 place(Eigen::Matrix3d::Identity(), Eigen::Vector3d(k > 0 ? 0.5 : 0.0, 0, 0));
    parent = model.addJoint(parent, JointModelRZ(), place, "link" + std::to_string(k));
    const double about = 1.0 * 0.5 * 0.5 / 12;
    const Eigen::Matrix3d inertia = Eigen::Vector3d(0, about, about).asDiagonal();
    model.appendBodyToJoint(parent, Inertia(1.0, Eigen::Vector3d(0.25, 0, 0), inertia));
  }
  return model;
}

template <class F>
static double least_us(int states, F work) {
  double least = 1e9;
  for (int repeat = 0; repeat < 7; ++repeat) {
    const auto begun = std::chrono::steady_clock::now();
    work();
    const std::chrono::duration<double> took = std::chrono::steady_clock::now() - begun;
    least = std::min(least, took.count());
  }
  return 1e6 * least / states;
}

int main(int count, char** sizes) {
  for (int k = 1; k < count; ++k) {
    const int links = std::atoi(sizes[k]);
    const Model model = chain(links);
    Data data(model);
    const int states = 4096;
    std::vector<Eigen::VectorXd> q, v, u;
    for (int i = 0; i < states; ++i) {
      q.push_back(Eigen::VectorXd::Random(links));
      v.push_back(Eigen::VectorXd::Random(links));
      u.push_back(Eigen::VectorXd::Random(links));
    }
    double sum = 0;
    const double aba_us = least_us(states, [&] {
      for (int i = 0; i < states; ++i) sum += aba(model, data, q[i], v[i], u[i], Convention::LOCAL)[0];
    });
    const double derivatives_us = least_us(states, [&] {
      for (int i = 0; i < states; ++i) {
        computeABADerivatives(model, data, q[i], v[i], u[i]);
        sum += data.ddq_dq(0, 0);
      }
    });
    // What p' needs of them: p2' dq''/dq and p2' dq''/dq'.
    Eigen::RowVectorXd p = Eigen::RowVectorXd::Random(links), by_q(links), by_v(links);
    const double product_us = least_us(states, [&] {
      for (int i = 0; i < states; ++i) {
        computeABADerivatives(model, data, q[i], v[i], u[i]);
        by_q.noalias() = p * data.ddq_dq;
        by_v.noalias() = p * data.ddq_dv;
        sum += by_q[0] + by_v[0];
      }
    });
    std::printf("{\"links\": %d, \"aba_us\": %.5f, \"derivatives_us\": %.5f, \"adjoint_us\": %.5f, \"sum\": %g}\n", links,
                aba_us, derivatives_us, product_us, sum);
    std::fflush(stdout);
  }
}
