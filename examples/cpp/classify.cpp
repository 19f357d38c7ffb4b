// Prints the class of a picture: classify MODEL.pt2 PICTURE.ppm
//
// The model is a package of darswin.deploy.export.export_package, made with fixed_lens=True and
// uint8 images (1, H, W, C). The picture is a binary PPM (RGB) or PGM (gray) file of H×W pixels.

#include <ATen/ATen.h>
#include <c10/core/InferenceMode.h>
#include <torch/csrc/inductor/aoti_package/model_package_loader.h>

#include <exception>
#include <fstream>
#include <iostream>
#include <sstream>
#include <string>

at::Tensor read_picture(const std::string& path) {
  std::ifstream file(path, std::ios::binary);
  TORCH_CHECK(file.is_open(), path, " cannot be opened");
  std::string kind;
  int64_t width = 0, height = 0, largest = 0;
  file >> kind >> width >> height >> largest;
  file.get();  // the one space before the pixels
  TORCH_CHECK(file && (kind == "P5" || kind == "P6") && largest == 255, path,
              " is not a binary PPM or PGM file with 8 bits and without comments");
  auto picture = at::empty({1, height, width, kind == "P6" ? 3 : 1}, at::kByte);
  TORCH_CHECK(file.read(static_cast<char*>(picture.data_ptr()), picture.numel()), path,
              " ends too early");
  return picture;
}

int main(int count, char** arguments) try {
  TORCH_CHECK(count == 3, "usage: classify MODEL.pt2 PICTURE.ppm");
  TORCH_CHECK(std::ifstream(arguments[1]).is_open(), arguments[1], " cannot be opened");
  const c10::InferenceMode guard;
  torch::inductor::AOTIModelPackageLoader model(arguments[1]);
  const at::Tensor picture = read_picture(arguments[2]);
  // The package itself does not check its inputs.
  std::ostringstream given;
  given << "uint8 " << picture.sizes().slice(1);
  const std::string wanted = model.get_metadata()["images"];
  TORCH_CHECK(given.str() == wanted, "the model takes ", wanted, ", the picture is ", given.str());
  const auto [probability, label] = model.run({picture}).at(0).softmax(1).max(1);
  std::cout << "class " << label.item<int64_t>() << ", probability " << probability.item<float>()
            << '\n';
} catch (const c10::Error& error) {
  std::cerr << "classify: " << error.what_without_backtrace() << '\n';
  return 1;
} catch (const std::exception& error) {
  std::cerr << "classify: " << error.what() << '\n';
  return 1;
}
