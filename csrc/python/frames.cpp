// The Python module darswin.frames._frames: NumPy arrays in, NumPy arrays out. It does not use
// torch.
#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include <algorithm>
#include <cctype>
#include <cerrno>
#include <memory>
#include <optional>
#include <span>
#include <string>
#include <system_error>
#include <vector>

#include "../core/dispatch.h"
#include "../core/network_file.h"
#include "../core/parallel.h"
#include "../core/rig.h"

// glibc 2.34 gave the same function a new version (see portable.cpp).
#if defined(__GLIBC__) && defined(__x86_64__)
__asm__(".symver pthread_once, pthread_once@GLIBC_2.2.5");
#elif defined(__GLIBC__) && defined(__aarch64__)
__asm__(".symver pthread_once, pthread_once@GLIBC_2.17");
#endif

namespace py = pybind11;

namespace darswin {
namespace {

template <typename T>
using Array = py::array_t<T, py::array::c_style | py::array::forcecast>;
using Shape = std::vector<int64_t>;

std::string shown(const Shape& shape) {
  std::string text = "(";
  for (const int64_t size : shape) text += std::to_string(size) + ", ";
  return text.substr(0, std::max<size_t>(text.size(), 3) - 2) + ")";
}

// NumPy's answer is exact. Where it would take more than milliseconds, which needs strange strides,
// NumPy gives up, and the arrays count as sharing memory.
bool share_memory(const py::array& one, const py::array& other) {
  constexpr int64_t kMostWork = 100'000;
  try {
    const py::object shares = py::module_::import("numpy").attr("shares_memory");
    return shares(one, other, py::arg("max_work") = kMostWork).cast<bool>();
  } catch (const py::error_already_set& error) {
    if (!error.matches(PyExc_RuntimeError)) throw;  // the base of NumPy's TooHardError
    return true;
  }
}

template <typename T>
std::span<const T> span_of(const Array<T>& array) {
  return {array.data(), static_cast<size_t>(array.size())};
}

// Checks for an array (H, W), (H, W, 1) or (H, W, 3) of uint8, called `what`.
Frame frame_of(const py::object& given, const std::string& what = "frame") {
  if (!py::isinstance<py::array_t<uint8_t>>(given)) {
    throw py::type_error(what + " must be a NumPy array of uint8, got " +
                         std::string(py::isinstance<py::array>(given)
                                         ? py::str(given.attr("dtype"))
                                         : py::str(py::type::of(given))));
  }
  const auto frame = py::reinterpret_borrow<py::array>(given);
  const Shape sizes(frame.shape(), frame.shape() + frame.ndim());
  const bool colors = sizes.size() == 3;
  const int64_t channels = colors ? sizes[2] : 1;
  if ((sizes.size() != 2 && !colors) || (channels != 1 && channels != 3)) {
    throw py::value_error(what + " must have shape (H, W), (H, W, 1) or (H, W, 3), got " +
                          shown(sizes));
  }
  return {.pixels = static_cast<const uint8_t*>(frame.data()),
          .height = sizes[0],
          .width = sizes[1],
          .channels = channels,
          .row_stride = frame.strides(0),
          .column_stride = frame.strides(1),
          .channel_stride = colors ? frame.strides(2) : 0};
}

void check_threads(int64_t threads) {
  if (threads < 1) throw py::value_error("threads must be at least 1");
}

// The array for a result of this type and these sizes: a new one, or the given one if it fits and
// shares no memory with the frames.
template <typename T>
py::array output_array(const py::object& given, const Shape& sizes, const py::tuple& frames) {
  if (given.is_none()) return py::array(py::dtype::of<T>(), sizes);
  if (!py::isinstance<py::array>(given)) {
    throw py::type_error("out must be a NumPy array, got " +
                         std::string(py::str(py::type::of(given))));
  }
  const auto out = py::reinterpret_borrow<py::array>(given);
  if (!py::isinstance<py::array_t<T>>(out) || !(out.flags() & py::array::c_style) ||
      !out.writeable() || Shape(out.shape(), out.shape() + out.ndim()) != sizes) {
    throw py::value_error("out must be a writeable, C-contiguous array of " +
                          std::string(py::str(py::dtype::of<T>())) + " with shape " + shown(sizes));
  }
  for (const py::handle frame : frames) {
    if (share_memory(py::reinterpret_borrow<py::array>(frame), out)) {
      throw py::value_error("out must not share memory with the frame");
    }
  }
  return out;
}

// Samples checked frames, of which `given` are the arrays.
template <typename Sampler, typename Frames>
py::array sample(const Sampler& sampler, const Frames& frames, int64_t channels,
                 const py::tuple& given, const py::object& out, int64_t threads) {
  check_threads(threads);
  sampler.check(frames);
  const bool colors = py::reinterpret_borrow<py::array>(given[0]).ndim() == 3;
  const Shape sizes = sampler.output_shape(channels, colors);
  py::array result = sampler.makes_bytes() ? output_array<uint8_t>(out, sizes, given)
                                           : output_array<float>(out, sizes, given);
  void* const to = result.mutable_data();
  const py::gil_scoped_release free;
  const ThreadLimit limit(threads);
  sampler.sample(frames, to);
  return result;
}

py::object run_network(const FrameNetwork& network, const py::object& given, const py::object& out,
                       int64_t threads) {
  const Frame frame = frame_of(given);
  check_threads(threads);
  network.check(frame);
  const bool is_list = network.finish() == FrameNetwork::Finish::list;
  const int64_t count = network.output_count();
  py::list results;
  std::vector<float*> to;
  if (is_list && !out.is_none() &&
      (!py::isinstance<py::list>(out) || static_cast<int64_t>(py::len(out)) != count)) {
    throw py::type_error("out must be a list of " + std::to_string(count) + " arrays, got " +
                         std::string(py::str(py::type::of(out))));
  }
  for (int64_t k = 0; k < count; ++k) {
    const py::object one = is_list && !out.is_none() ? py::object(out[py::int_(k)]) : out;
    py::array result = output_array<float>(one, network.output_shape(k), py::make_tuple(given));
    for (const py::handle other : results) {
      if (share_memory(py::reinterpret_borrow<py::array>(other), result)) {
        throw py::value_error("the arrays of out must not share memory");
      }
    }
    to.push_back(static_cast<float*>(result.mutable_data()));
    results.append(std::move(result));
  }
  {
    const py::gil_scoped_release free;
    const ThreadLimit limit(threads);
    network.run(frame, to.data());
  }
  if (!is_list) return results[0];
  return out.is_none() ? results : out;
}

// Opens a file. What the system cannot read is an OSError.
template <typename File>
std::shared_ptr<const File> opened(const std::string& path) {
  try {
    const py::gil_scoped_release free;
    return std::make_shared<const File>(path);
  } catch (const std::system_error& error) {
    errno = error.code().value();
    PyErr_SetFromErrnoWithFilename(PyExc_OSError, path.c_str());
    throw py::error_already_set();
  }
}

// Returns the arrays and the texts of a file.
py::tuple read_tensors(const std::string& path) {
  const auto file = opened<TensorFile>(path);
  py::dict arrays;
  for (const auto& [name, tensor] : file->tensors) {
    // NumPy's "i4" is "I32" here.
    const std::string bytes = std::to_string(std::stoi(tensor.type.substr(1)) / 8);
    const py::dtype kind(static_cast<char>(std::tolower(tensor.type[0])) + bytes);
    arrays[py::str(name)] = py::array(kind, tensor.shape, tensor.data);  // a copy
  }
  return py::make_tuple(arrays, file->texts);
}

// Returns a function that runs the network of a file, and what the file says of it: the size of the
// frames, the shapes of the outputs, and the labels.
py::tuple open_network(const std::string& path) {
  const auto network = opened<FrameNetwork>(path);
  const py::cpp_function run(
      [network](const py::object& frame, const py::object& out, int64_t threads) {
        return run_network(*network, frame, out, threads);
      },
      py::name("run"), py::arg("frame"), py::arg("out") = py::none(), py::arg("threads") = 1);
  py::list shapes, labels;
  for (int64_t k = 0; k < network->output_count(); ++k) {
    shapes.append(py::tuple(py::cast(network->output_shape(k))));
  }
  for (const std::string& label : network->labels()) labels.append(py::str(label));
  return py::make_tuple(run,
                        py::make_tuple(network->height(), network->width(), network->channels()),
                        shapes, labels);
}

// Finds the places of the points of one polar grid among the pixels of images of one size.
py::tuple polar_places(const Array<float>& radii, const Array<float>& azimuths,
                       const Array<float>& center, const std::optional<Array<float>>& affine,
                       const std::optional<Array<float>>& offsets,
                       std::pair<int64_t, int64_t> size) {
  const py::ssize_t count = radii.size(), around = azimuths.size();
  if (center.size() != 2 || (affine && affine->size() != 4) ||
      (offsets && offsets->size() != 2 * count * around)) {
    throw py::value_error("the arrays of the grid do not fit together");
  }
  PolarSampleArgs<float> a{};
  a.height = size.first, a.width = size.second;
  a.radii = radii.data(), a.num_radii = count, a.num_azimuths = around;
  a.center = center.data();
  if (affine) a.affine = affine->data();
  if (offsets) a.offsets = offsets->data(), a.offsets_end = a.offsets + offsets->size();
  const int64_t padded = (around + 15) / 8 * 8;
  std::vector<double> angles(3 * padded);
  std::copy_n(azimuths.data(), around, angles.begin());
  py::array_t<int16_t> columns({count, around}), rows({count, around});
  py::array_t<float> right({count, around}), lower({count, around});
  kernels<FrameKernels>().places(a, angles.data(), padded, columns.mutable_data(),
                                 rows.mutable_data(), right.mutable_data(), lower.mutable_data());
  return py::make_tuple(columns, rows, right, lower);
}

// A picture (H, W, C) at points (k·H', k·W', 2): (H', W', C), each the mean of k² points. For a
// picture or two through one lens: a sampler first arranges the points for many.
template <typename T>
py::array_t<T> read(const Array<T>& picture, const Array<float>& points, int64_t reads) {
  if (picture.ndim() != 3 || points.ndim() != 3 || points.shape(2) != 2 || reads < 1 ||
      points.shape(0) % reads || points.shape(1) % reads) {
    throw py::value_error("expected a picture (H, W, C), and points (k·H', k·W', 2)");
  }
  constexpr int64_t kMost = 1 << 24;  // exact in float
  if (std::max(picture.shape(0), picture.shape(1)) > kMost || picture.size() == 0) {
    throw py::value_error("a picture has 1 to 2^24 rows and columns, and channels");
  }
  const int64_t rows = points.shape(0) / reads, columns = points.shape(1) / reads;
  py::array_t<T> result({rows, columns, picture.shape(2)});
  const ReadArgs<T> args{.picture = picture.data(),
                         .height = picture.shape(0),
                         .width = picture.shape(1),
                         .channels = picture.shape(2),
                         .points = points.data(),
                         .columns = columns,
                         .reads = reads,
                         .to = result.mutable_data()};
  const py::gil_scoped_release others_may_run;
  const auto& kernel = kernels<ReadKernels<T>>();
  const auto run = args.channels == 3   ? kernel.three
                   : args.channels == 4 ? kernel.four
                                        : kernel.any;
  run(args, rows);
  return result;
}

}  // namespace
}  // namespace darswin

PYBIND11_MODULE(_frames, m) {
  using namespace darswin;
  m.doc() = "The compiled part of darswin.frames.";
  // A function: of a class, __new__ would make objects whose memory nothing has filled.
  m.def("sampler", [](const Array<int16_t>& columns, const Array<int16_t>& rows,
                      const Array<float>& right, const Array<float>& lower,
                      std::pair<int64_t, int64_t> size, std::vector<float> scale,
                      std::vector<float> offset, const std::string& output, int64_t reads) {
    const auto sampler = std::make_shared<const FrameSampler>(
        FramePlan{.shape = Shape(columns.shape(), columns.shape() + columns.ndim()),
                  .columns = span_of(columns),
                  .rows = span_of(rows),
                  .right = span_of(right),
                  .lower = span_of(lower),
                  .height = size.first,
                  .width = size.second,
                  .scale = std::move(scale),
                  .offset = std::move(offset),
                  .output = output,
                  .reads = reads});
    return py::cpp_function(
        [sampler](const py::object& frame, const py::object& out, int64_t threads) {
          const Frame checked = frame_of(frame);
          return sample(*sampler, checked, checked.channels, py::make_tuple(frame), out, threads);
        },
        py::name("sample"), py::arg("frame"), py::arg("out") = py::none(), py::arg("threads") = 1);
  });
  m.def("rig_sampler", [](const Array<uint16_t>& counts, const Array<uint8_t>& sources,
                          const Array<int16_t>& columns, const Array<int16_t>& rows,
                          const Array<float>& right, const Array<float>& lower,
                          const Array<float>& weights,
                          std::vector<std::pair<int64_t, int64_t>> sizes,
                          std::vector<std::string> names, std::vector<float> scale,
                          std::vector<float> offset, const std::string& output) {
    if (counts.ndim() != 2) throw py::value_error("the plan's counts must have shape (H, W)");
    const auto sampler = std::make_shared<const RigSampler>(RigPlan{.counts = span_of(counts),
                                                                    .sources = span_of(sources),
                                                                    .columns = span_of(columns),
                                                                    .rows = span_of(rows),
                                                                    .right = span_of(right),
                                                                    .lower = span_of(lower),
                                                                    .weights = span_of(weights),
                                                                    .height = counts.shape(0),
                                                                    .width = counts.shape(1),
                                                                    .sizes = std::move(sizes),
                                                                    .names = std::move(names),
                                                                    .scale = std::move(scale),
                                                                    .offset = std::move(offset),
                                                                    .output = output});
    return py::cpp_function(
        [sampler](const py::tuple& frames, const py::object& out, int64_t threads) {
          std::vector<Frame> checked;
          for (size_t k = 0; k < sampler->names().size(); ++k) {
            checked.push_back(frame_of(frames[k], "the frame of " + sampler->names()[k]));
          }
          return sample(*sampler, checked, checked[0].channels, frames, out, threads);
        },
        py::name("sample"), py::arg("frames"), py::arg("out") = py::none(), py::arg("threads") = 1);
  });
  m.def("network", &open_network);
  m.def("read_tensors", &read_tensors);
  m.def("polar_places", &polar_places);
  m.def("read", &read<uint8_t>, py::arg().noconvert(), py::arg(), py::arg());
  m.def("read", &read<float>, py::arg().noconvert(), py::arg(), py::arg());
}
